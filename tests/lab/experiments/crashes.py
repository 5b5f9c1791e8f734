"""Runs that die at an operation on a file, and what is left of them.

`run_training` is called in the children of a `tests.zygote`.
The runs are small and real except for their learner, which is
`tests.lab.experiments.fake_learner`.
"""

from collections.abc import Mapping, Sequence
import io
import os
import pathlib
import shutil
import signal
import sys
from typing import Any, final

import yaml

from realab_suite.evaluation import results
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import judging
from realab_suite.lab.verdicts import stakes
from realab_suite.launchers import program
from realab_suite.launchers import train
from tests import zygote
from tests.lab.experiments import fake_learner
from tests.lab.experiments import small

_RUN = 'reward'
_SEED = 3
_EXPERIMENT = {
    **small.EXPERIMENT,
    'max_steps': 5,
    'baselines': [],
    'training': {
        'num_envs': 2,
        'steps': 48,
        'checkpoint_every': 16,
        'curve_every': 8,
    },
}
# The same in a class of tasks: adaptation begins after a checkpoint of its own.
CLASS = {
    **_EXPERIMENT,
    'task': 'assistant.held_out',
    'training': {
        **_EXPERIMENT['training'],
        'steps': 20,
        'adaptation': 16,
        'tasks': ['assistant.train'],
    },
}
_NAMES = (
    storage.CONFIG,
    storage.DONE,
    training.EPISODES,
    training.TRACE,
    training.CURVE,
    training.TRAINING_EPISODES,
    training.LEARNER,
)
# Ways to die at an operation on a file: before it, or in the middle of a write.
WAYS = KILLED, TORN = 'killed', 'torn'


# ---- Called in children ------------------------------------------------------


def run_training(
    experiment: str,
    output: str,
    *,
    die_at: int = 0,
    way: str = KILLED,
    count: str | None = None,
    measured: str = '',
) -> None:
  """Runs the command line of a run; never returns.

  Args:
    experiment: File of the experiment.
    output: Folder of results.
    die_at: Number of the operation on files to die at; 0 for none.
    way: Way to die.
    count: File to write the number of operations to.
    measured: Folder with the stakes of another run, which are not measured
      again, but written like new ones.
  """
  training.make_learner = fake_learner.make
  if measured:
    known = {
        path.stem: stakes.Stakes.model_validate_json(path.read_bytes())
        for path in pathlib.Path(measured).rglob('stakes/*.json')
    }
    judging.stakes_of = lambda *what: known[judging.key_of_stakes(*what)]
  shim = _Shim(die_at, way)
  shim.install()
  sys.argv = ['train', f'--experiment={experiment}', f'--run={_RUN}',
              f'--seed={_SEED}', f'--output={output}']  # fmt: skip
  try:
    program.start(train.main)
  finally:
    if count is not None:
      pathlib.Path(count).write_text(str(shim.num_done))


# ---- Operations on files -----------------------------------------------------


@final
class _Shim:
  """Counts operations on files, and kills the process."""

  def __init__(self, die_at: int, way: str) -> None:
    self.num_done = 0
    self._die_at = die_at
    self._way = way
    self._write = io.FileIO.write

  def install(self) -> None:
    """Replaces the operations on files of this process."""
    shim, replace, unlink = self, os.replace, pathlib.Path.unlink

    class File(io.FileIO):
      """A file whose writes are counted."""

      def write(self, data: Any) -> int:
        shim.reach(self, bytes(data))
        return super().write(data)

      def truncate(self, size: int | None = None) -> int:
        shim.reach()
        return super().truncate(size)

    def open_counted(path: Any, mode: str = 'r', **options: Any) -> Any:
      if mode == 'rb':
        return open(path, mode)
      raw = File(os.fspath(path), mode.replace('b', ''))
      if options.get('buffering') == 0:
        return raw
      return io.BufferedWriter(raw)

    def counted_replace(source: Any, target: Any) -> None:
      shim.reach()
      replace(source, target)

    def counted_unlink(path: Any, **options: Any) -> None:
      shim.reach()
      unlink(path, **options)

    storage.open = results.open = open_counted
    os.replace = counted_replace
    pathlib.Path.unlink = counted_unlink

  def reach(self, file: Any = None, data: bytes = b'') -> None:
    """Counts an operation, and ends the process at the last one."""
    self.num_done += 1
    if self.num_done != self._die_at:
      return
    if self._way == TORN and file is not None:
      self._write(file, data[: len(data) // 2])
    os.kill(os.getpid(), signal.SIGKILL)


# ---- Called in tests ---------------------------------------------------------


@final
class Killer:
  """Starts runs, kills them, and continues them."""

  def __init__(
      self,
      nursery: zygote.Zygote,
      root: pathlib.Path,
      experiment: Mapping[str, Any] = _EXPERIMENT,
  ) -> None:
    """Runs once without a kill, for comparison."""
    self._nursery = nursery
    self._root = root
    self._experiment = root / 'experiment.yaml'
    self._experiment.write_text(yaml.safe_dump(experiment))
    [self._job] = jobs.plan(experiment_specs.load(self._experiment))
    self._names = _NAMES
    if self._job.training.tasks:
      self._names += (training.STAGES,)
    count = root / 'count'
    ended = self._train(root / 'whole', count=str(count))
    if ended.status:
      raise RuntimeError(f'a run without a kill has failed: {ended.said}')
    self.num_operations = int(count.read_text())
    self._whole = self._results(root / 'whole')
    self._num_outputs = 0

  def kill_and_finish(self, kills: Sequence[tuple[int, str]]) -> list[str]:
    """Kills a run at operations, one after the other, then lets it finish.

    Args:
      kills: Numbers of operations, counted from each start, and ways to die.

    Returns:
      Complaints: of a run that failed, or files that differ from those of a run
      without a kill.
    """
    self._num_outputs += 1
    output = self._root / str(self._num_outputs)
    for number, way in kills:
      ended = self._train(output, die_at=number, way=way)
      # Near its end a continued run has fewer operations than the first one.
      if ended.status not in (0, -signal.SIGKILL):
        return [f'failed before it was killed: {ended}']
    ended = self._train(output)
    if ended.status:
      return [f'did not continue: {ended}']
    found = self._results(output)
    shutil.rmtree(output)
    names = sorted(found.keys() | self._whole.keys())
    return [name for name in names if found.get(name) != self._whole.get(name)]

  def _train(self, output: pathlib.Path, **options: Any) -> zygote.Ended:
    return self._nursery.call(
        'run_training',
        experiment=str(self._experiment),
        output=str(output),
        measured=str(self._root / 'whole') if output.name != 'whole' else '',
        **options,
    )

  def _results(self, output: pathlib.Path) -> dict[str, bytes]:
    folder = output / self._job.folder()
    return {name: (folder / name).read_bytes() for name in self._names}
