"""The lines that campaigns print: `Cxx figure target verdict seed`."""

from typing import final


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
