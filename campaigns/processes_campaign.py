"""Campaign C35: processes and threads end, and errors have names.

Run from the root of the repository, about four minutes on two processors:

    python -m campaigns.processes_campaign

A process makes an environment, which draws frames where there is a renderer,
and starts another one by spawn, forkserver or fork, which does the same. Both
use it from the thread that made it or from another one, and both leave by
coming to an end or by an exception. Nothing may hang for 30 seconds, no error
may be anything but this package's, and both have to end with the exit status
that their end asks for. Arguments: which share of the combinations, and a seed
that chooses them.
"""

import ctypes.util
import itertools
import json
import multiprocessing
import os
import pathlib
import random
import subprocess
import sys
import threading
from typing import Any, NamedTuple

import numpy as np

from campaigns import figure_lines
from realab_suite import errors
from realab_suite import suite
from tests import patience

METHODS = ('spawn', 'forkserver', 'fork')
THREADS = ('owner', 'other')
EXITS = ('exit', 'exception')
_ROOT = pathlib.Path(__file__).parents[1]
_RENDERS = """
from dm_control import mujoco
xml = '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>'
mujoco.Physics.from_xml_string(xml).render(8, 8)
"""
_UNCLEAN = ('Exception ignored', 'Fatal Python error', 'Segmentation fault')


class Cell(NamedTuple):
  """A combination; the first four are options of the campaign.

  Attributes:
    method: How the second process is started.
    gl: What renders, or `disable`.
    thread: Whether the thread that made an environment uses it.
    leaving: How both processes end.
    planted: `hang` or `error`, for a control.
  """

  method: str
  gl: str
  thread: str
  leaving: str
  planted: str = ''


class Result(NamedTuple):
  """What became of a cell.

  Attributes:
    num_hung: Processes that had not ended in time.
    num_unnamed: Errors that are not this package's.
    num_unclean: Exits with another status or with complaints.
    num_used: Processes that have used an environment, or been refused.
    num_refused: Those that have been refused, by an error with a name.
    words: What went wrong.
  """

  num_hung: int
  num_unnamed: int
  num_unclean: int
  num_used: int
  num_refused: int
  words: str


class PlantedError(Exception):
  """What a process ends by, where it is to end by an exception."""


def renderers() -> list[str]:
  """Returns what `MUJOCO_GL` can be here."""
  found = ['disable']
  if _works('egl'):
    found.append('egl')
  if ctypes.util.find_library('OSMesa') and _works('osmesa'):
    found.append('osmesa')
  return found


def _works(gl: str) -> bool:
  ran = subprocess.run(
      [sys.executable, '-c', _RENDERS],
      env={**os.environ, 'MUJOCO_GL': gl},
      capture_output=True,
      timeout=patience.SECONDS,
      check=False,
  )
  return ran.returncode == 0


def cells(gls: list[str]) -> list[Cell]:
  """Returns all combinations."""
  return [
      Cell(*each) for each in itertools.product(METHODS, gls, THREADS, EXITS)
  ]


def run(cell: Cell) -> Result:
  """Runs a cell in a process of its own."""
  command = [sys.executable, '-m', __name__, '--cell', json.dumps(cell)]
  if __name__ == '__main__':
    command[2] = 'campaigns.processes_campaign'
  process = subprocess.Popen(
      command,
      cwd=_ROOT,
      env={**os.environ, 'MUJOCO_GL': cell.gl},
      stdout=subprocess.PIPE,
      stderr=subprocess.PIPE,
      text=True,
      start_new_session=True,
  )
  try:
    # The first process waits for the second one, too.
    out, err = process.communicate(timeout=2 * patience.SECONDS)
  except subprocess.TimeoutExpired:
    process.kill()
    out, err = process.communicate()
    return Result(1, 0, 0, 0, 0, f'{cell} hangs: {err[-300:]}')
  said = [json.loads(line) for line in out.splitlines() if line[:1] == '{']
  used = [each for each in said if 'error' in each]
  hung = sum(each.get('hangs', False) for each in said)
  unnamed = [each for each in used if each['error'] and not each['is_ours']]
  asked = int(cell.leaving == 'exception')
  statuses = [process.returncode, *(e['status'] for e in said if 'status' in e)]
  complaints = [text for text in _UNCLEAN if text in err]
  # Every traceback is that of the exception that was asked for.
  tracebacks = err.count('Traceback') - err.count('PlantedError: planted')
  unclean = sum(s != asked for s in statuses) + len(complaints)
  unclean += tracebacks != 0
  words = ''
  if hung or unnamed or unclean or len(used) != 2:
    words = f'{cell}: {said} {statuses} {err[-300:]!r}'
  return Result(
      hung,
      len(unnamed),
      unclean,
      len(used),
      sum(bool(each['error']) for each in used),
      words,
  )


def _say(**what: Any) -> None:
  sys.stdout.write(json.dumps(what) + '\n')
  sys.stdout.flush()


def _first(cell: Cell) -> None:
  """What the first process does."""
  env = _load(cell)
  _use(cell, env)
  context = multiprocessing.get_context(cell.method)
  child = context.Process(target=_second, args=(cell,))
  child.start()
  child.join(patience.SECONDS)
  if child.exitcode is None:
    _say(hangs=True)
    child.kill()
    child.join()
  else:
    _say(status=child.exitcode)
  _leave(cell)


def _second(cell: Cell) -> None:
  """What the second process does."""
  if cell.planted == 'hang':
    threading.Event().wait()
  _use(cell, _load(cell))
  _leave(cell)


def _load(cell: Cell) -> Any:
  camera = {} if cell.gl == 'disable' else {'camera_size': (16, 16)}
  return suite.load(
      'collect_apples', 'near', {'random': 1, **camera},
      design='instantaneous_reward',
  )  # fmt: skip


def _use(cell: Cell, env: Any) -> None:
  """Uses an environment, and says what came of it."""
  if cell.thread == 'owner':
    _step(cell, env)
    return
  thread = threading.Thread(target=_step, args=(cell, env))
  thread.start()
  thread.join()


def _step(cell: Cell, env: Any) -> None:
  error: BaseException | None = None
  try:
    env.reset()
    for _ in range(3):
      env.step(np.zeros(6))
    if cell.planted == 'error':
      raise PlantedError('an error without a name')
  except Exception as caught:  # Whatever it is, it is reported.
    error = caught
  _say(
      error=repr(error) if error else '',
      is_ours=isinstance(error, errors.RealabError),
  )


def _leave(cell: Cell) -> None:
  # The environment is left open: processes end without saying goodbye.
  if cell.leaving == 'exception':
    raise PlantedError('planted')


def main(share: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  everything = cells(renderers())
  number = max(1, round(share * len(everything)))
  chosen = random.Random(seed).sample(everything, number)
  results = [run(cell) for cell in chosen]
  for result in results:
    if result.words:
      print(f'# {result.words}', flush=True)
  report = figure_lines.Lines('C35', seed)
  report.at_least('combinations', len(results), number)
  report.at_least(
      'processes that used an environment',
      sum(result.num_used for result in results),
      2 * number,
  )
  print(
      f'# refused by name: {sum(result.num_refused for result in results)};'
      f' renderers: {sorted({cell.gl for cell in chosen})}'
  )
  for figure in ('hung', 'unnamed', 'unclean'):
    total = sum(getattr(result, f'num_{figure}') for result in results)
    report.at_most(figure, total, 0)
  return report.num_missed


if __name__ == '__main__':
  if sys.argv[1:2] == ['--cell']:
    _first(Cell(*json.loads(sys.argv[2])))
  else:
    figure_lines.run(main)
