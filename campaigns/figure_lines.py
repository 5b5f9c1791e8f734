"""Output of campaigns, `Cxx figure target verdict seed`, and their start."""

from collections.abc import Callable
import inspect
import sys
from typing import NoReturn, final


def run(main: Callable[..., int]) -> NoReturn:
  """Runs a campaign with the arguments of the command line.

  python -m campaigns.NAME_campaign [scale] [seed]

  Args:
    main: Returns the number of targets missed. The type of each parameter
      converts a text.
  """
  kinds = inspect.signature(main).parameters.values()
  texts = sys.argv[1:]
  try:
    for i, kind in enumerate(kinds):
      if kind.kind is kind.VAR_POSITIONAL:
        break
      texts[i : i + 1] = [kind.annotation(text) for text in texts[i : i + 1]]
  except ValueError:
    sys.exit('usage: python -m campaigns.NAME_campaign [scale] [seed]')
  sys.exit(main(*texts))


@final
class Lines:
  """Prints a line per figure, and counts the targets that were missed.

  lines = Lines('C43', seed)
  lines.at_most('state changes', num_changes, 0)
  sys.exit(lines.num_missed)
  """

  def __init__(self, campaign: str, seed: int) -> None:
    self._campaign = campaign
    self._seed = seed
    self.num_missed = 0

  def at_most(self, figure: str, value: float, limit: float) -> None:
    self._print(figure, value, f'<={limit:g}', value <= limit)

  def at_least(self, figure: str, value: float, limit: float) -> None:
    self._print(figure, value, f'>={limit:g}', value >= limit)

  def _print(
      self, figure: str, value: float, target: str, is_met: bool
  ) -> None:
    self.num_missed += not is_met
    words = 'met' if is_met else 'MISSED'
    print(
        f'{self._campaign} {figure}={value:.6g} {target} {words} {self._seed}',
        flush=True,
    )
