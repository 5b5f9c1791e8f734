"""What campaigns print, `Cxx figure target verdict seed`; how they start."""

from collections.abc import Callable, Mapping, Sequence
import inspect
import sys
from typing import NoReturn, final


def run(main: Callable[..., int]) -> NoReturn:
  """Runs a campaign with what the command line says, in the order of `main`.

  python -m campaigns.NAME_campaign [scale] [seed]

  Args:
    main: Returns the number of targets missed; each of its parameters has a
      type that a text can become.
  """
  kinds = inspect.signature(main).parameters.values()
  texts = sys.argv[1:]
  for i, kind in enumerate(kinds):
    if kind.kind is kind.VAR_POSITIONAL:
      break
    texts[i : i + 1] = [kind.annotation(text) for text in texts[i : i + 1]]
  sys.exit(main(*texts))


@final
class Lines:
  """Prints a line per figure, and counts the targets that were missed.

  lines = Lines('C27', seed)
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

  def within(self, figure: str, value: float, low: float, high: float) -> None:
    self._print(figure, value, f'{low:g}..{high:g}', low <= value <= high)

  def _print(
      self, figure: str, value: float, target: str, is_met: bool
  ) -> None:
    self.num_missed += not is_met
    words = 'met' if is_met else 'MISSED'
    print(
        f'{self._campaign} {figure}={value:.6g} {target} {words} {self._seed}',
        flush=True,
    )


def print_all(
    runs: Mapping[str, Callable[[Lines, float, int], None]],
    scale: float,
    seed: int,
    names: Sequence[str],
) -> int:
  """Runs several campaigns; returns the number of targets missed.

  Args:
    runs: By name, what prints the lines of one of them.
    scale: Of each.
    seed: Of each.
    names: Which ones; all if there is none.
  """
  missed = 0
  for name in names or runs:
    lines = Lines(name, seed)
    runs[name](lines, scale, seed)
    missed += lines.num_missed
  return missed
