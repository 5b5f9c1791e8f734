"""Campaign C37: a disk that is full, read only or gone is told in one line.

Run from the root of the repository, about two minutes:

    python -m campaigns.disk_campaign [scale] [seed]

A run meets a limit on the size of its files, at 50 offsets from nothing to the
largest; a full disk (`/dev/full`) for each of its files; a folder that becomes
read only, and one that is removed, in the middle of training. It has to end
with an exit status that is not zero and one line that names a file and the
cause. Its last checkpoint has to be whole: the same command goes on, once there
is room, and ends as a run that nothing has happened to.
"""

import dataclasses
import errno
import os
import pathlib
import re
import shutil
import tempfile
from typing import Any, final

import numpy as np

from campaigns import figure_lines
from campaigns import kill_campaign
from campaigns import victims
from campaigns import zygote
from realab_suite.experiments import storage
from realab_suite.experiments import training

OFFSETS = 50
_CAUSES = {
    name: os.strerror(name)
    for name in (errno.EFBIG, errno.ENOSPC, errno.EACCES, errno.ENOENT)
}


@final
@dataclasses.dataclass
class Tally:
  """What became of runs whose disk failed.

  Attributes:
    failed: How many ended with an exit status that is not zero.
    complaints: What is wrong with how others ended, or with what they said.
    lost: What is wrong with how they went on.
  """

  failed: int = 0
  complaints: list[str] = dataclasses.field(default_factory=list)
  lost: list[str] = dataclasses.field(default_factory=list)


@final
class Vandal:
  """Lets a run fail, and sees how it ends and goes on."""

  def __init__(self, killer: kill_campaign.Killer, root: pathlib.Path) -> None:
    self._killer = killer
    self._root = root
    self._num_outputs = 0
    self.tally = Tally()

  def limit(self, size: int) -> None:
    """No file may be larger than so many bytes."""
    self._check(self._output(), errno.EFBIG, f'limit of {size}', limit=size)

  def fill(self, name: str) -> None:
    """The disk is full when a file is to be written whole."""
    output = self._output()
    partial = output / self._killer.job.folder() / f'{name}.partial'
    partial.parent.mkdir(parents=True)
    partial.symlink_to('/dev/full')
    self._check(output, errno.ENOSPC, f'full for {name}')

  def have_accident(self, name: str, bug: str | None = None) -> None:
    """Something happens to the folder in the middle of training."""
    code = errno.ENOSPC
    if 'read only' in name:
      code = errno.EACCES
    elif 'removed' in name:
      code = errno.ENOENT
    self._check(self._output(), code, name, accident=name, bug=bug)

  def forbid(self) -> None:
    """The folder of all results is read only."""
    output = self._output()
    output.mkdir(mode=0o500)
    self._check(output, errno.EACCES, 'results are read only')

  def _output(self) -> pathlib.Path:
    self._num_outputs += 1
    return self._root / f'vandal{self._num_outputs}'

  def _check(
      self, output: pathlib.Path, code: int, what: str, **options: Any
  ) -> None:
    ended = self._killer.train(output, **options)
    problem = _problem(ended, code, output)
    self.tally.failed += ended.status > 0
    if problem:
      self.tally.complaints.append(f'{what}: {problem}')
    for path in (output, *output.rglob('*')):
      if path.is_dir():
        path.chmod(0o700)
    before = self._killer.tally
    self._killer.tally = kill_campaign.Tally()
    self._killer.finish(output, what)
    self.tally.lost += self._killer.tally.failures
    self.tally.lost += self._killer.tally.differing
    self._killer.tally = before
    shutil.rmtree(output)


def _problem(ended: zygote.Ended, code: int, output: pathlib.Path) -> str:
  """Returns what is wrong with how a run ended, or nothing."""
  if ended.status <= 0:
    return f'exit status {ended.status}'
  said = [line for line in ended.said.splitlines() if 'step ' not in line]
  if len(said) != 1:
    return f'{len(said)} lines: {said[-1:]}'
  if not re.match(rf'error: {re.escape(str(output))}[^:]*: ', said[0]):
    return f'names no file: {said[0]}'
  if _CAUSES[code] not in said[0]:
    return f'names no cause: {said[0]}'
  return ''


def files_written_whole() -> list[str]:
  """Returns the files of a run that are replaced as a whole."""
  steps = range(16, 49, 16)
  return [
      storage.CONFIG, training.LEARNER, training.TRACE, training.EPISODES,
      storage.DONE, *(f'checkpoints/{step:012d}.ckpt' for step in steps),
  ]  # fmt: skip


def largest_file(killer: kill_campaign.Killer) -> int:
  """Returns the size of the largest file of the run."""
  return max(
      path.stat().st_size
      for path in killer.whole_folder.rglob('*')
      if path.is_file()
  )


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints every figure and returns the number of targets missed."""
  lines = figure_lines.Lines('C37', seed)
  with (
      tempfile.TemporaryDirectory() as folder,
      zygote.Zygote(victims.__name__) as nursery,
  ):
    killer = kill_campaign.Killer(nursery, pathlib.Path(folder))
    vandal = Vandal(killer, pathlib.Path(folder))
    count = max(round(scale * OFFSETS), 2)
    largest = largest_file(killer)
    # Up to the last one at which something does not fit.
    for size in np.linspace(0, largest - 1, count).round().astype(int):
      vandal.limit(int(size))
    names = files_written_whole()
    for name in names:
      vandal.fill(name)
    for name in victims.ACCIDENTS:
      vandal.have_accident(name)
    vandal.forbid()
  tally = vandal.tally
  cases = count + len(names) + len(victims.ACCIDENTS) + 1
  lines.at_least('runs that failed', tally.failed, cases)
  lines.at_most('runs that did not say why', len(tally.complaints), 0)
  lines.at_most('runs that lost something', len(tally.lost), 0)
  for complaint in (*tally.complaints, *tally.lost):
    print(f'  {complaint}')
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
