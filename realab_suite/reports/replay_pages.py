"""Pages that replay evaluation episodes in 3D, each in one file.

The pages load nothing, and open in a browser without a network connection.
"""

from collections.abc import Callable
import contextlib
import json
import math
import pathlib
from typing import Any

import numpy as np

from realab_suite.engine import environment
from realab_suite.entities import block_kinds
from realab_suite.entities import grasps
from realab_suite.evaluation import results
from realab_suite.experiments import storage
from realab_suite.experiments import tracking
from realab_suite.interop.browser import recordings
from realab_suite.reports import replays
from realab_suite.reports import sweep_results

_PARTS = ('obstruction', 'permanent', 'temporary')


def name(row: results.EpisodeRow) -> str:
  """Returns the file name of the page of an episode."""
  run = ''.join(c if c.isalnum() or c in '._-' else '_' for c in row.info.run)
  return f'{run}-seed{row.seed}-world{row.world}-episode{row.episode}.html'


def write(
    run: sweep_results.Run, row: results.EpisodeRow, folder: pathlib.Path
) -> pathlib.Path:
  """Replays an episode and writes its page, over an existing one.

  Args:
    run: The run.
    row: An evaluation episode of the run.
    folder: Folder of the page; it is created if it does not exist.

  Returns:
    The path of the page.

  Raises:
    ResultsError: If the episode has no trace, the replay differs, or the page
      cannot be written.
  """
  scenes: list[recordings.Recording] = []
  touched: dict[str, list[tuple[int, str]]] = {}

  def start(
      env: environment.Environment, stack: contextlib.ExitStack
  ) -> Callable[[Any, tracking.Track], None]:
    def add(unused_physics: Any, track: tracking.Track) -> None:
      if not scenes:
        # A scene begins in a world that was reset.
        scene = contextlib.closing(recordings.Recording(env))
        scenes.append(stack.enter_context(scene))
      scenes[0].add()
      for block, kind in contacts(env).items():
        steps = touched.setdefault(block, [])
        if kind is not None and track.num_steps:
          steps.append((track.num_steps, kind))

    return add

  track = replays.replay(run, row, start)
  data = timeline(track, touched)
  data['title'] = f'{row.info.run}: {row.info.domain}.{row.info.task}'
  data['note'] = f'{replays.words(row)}; ended by {row.end}'
  page = recordings.with_timeline(
      scenes[0].page(), json.dumps(data, allow_nan=False)
  )
  with storage.explained(folder):
    folder.mkdir(parents=True, exist_ok=True)
  path = folder / name(row)
  storage.write_whole(path, page.encode())
  return path


def timeline(
    track: tracking.Track, contacts: dict[str, list[tuple[int, str]]]
) -> dict[str, Any]:
  """Returns the data of a time line, as plain data without NaN.

  Args:
    track: Track of the episode.
    contacts: Steps and kinds of the contacts of each block, by its name.
  """
  readings = [r.reading[1:] for r in track.feedback.values()]
  observed = np.sum(readings, axis=0) if readings else np.zeros(track.num_steps)
  return {
      'timestep': track.timestep,
      'true_return': _rounded(np.cumsum([0.0, *track.true_rewards])),
      'observed_return': _rounded(np.cumsum([0.0, *observed])),
      'registers': {
          name: {
              'role': register.role,
              'clean': _rounded(register.clean),
              'applied': _rounded(register.applied),
              'reading': _rounded(register.reading),
              **{part: _rounded(getattr(register, part)) for part in _PARTS},
          }
          for name, register in track.registers.items()
      },
      'contacts': [
          {'block': block, 'steps': steps} for block, steps in contacts.items()
      ],
  }


def _rounded(values: Any) -> list[float | None]:
  """Returns numbers with six significant digits; `None` if not finite."""
  return [
      float(f'{value:.6g}') if math.isfinite(value) else None
      for value in map(float, values)
  ]


def contacts(env: environment.Environment) -> dict[str, str | None]:
  """Returns the contact of each block that can be pushed, by its name.

  Args:
    env: Environment with a task of this package, in the middle of an episode.

  Returns:
    `held` by the avatar's hand, `touched` by the avatar, `hit` by a block of
    another register, or `None`.
  """
  physics = env.thin_physics
  pairs = np.asarray(physics.data.ptr.contact.geom).reshape(-1, 2)

  def ids(elements: Any) -> set[int]:
    return set(np.ravel(physics.bind(elements).element_id).tolist())

  avatar = ids(env.task.avatar.mjcf_model.find_all('geom'))
  blocks = {
      f'{register_name}/{block.body.name}': block
      for register_name, register in env.mechanism.registers.items()
      for block in register.blocks
      if isinstance(block, block_kinds.JointedBlock)
  }
  geoms = {one: ids(block.geom) for one, block in blocks.items()}
  others = set().union(*geoms.values())
  found: dict[str, str | None] = dict.fromkeys(blocks)
  for one, block in blocks.items():
    own = np.isin(pairs, list(geoms[one])).any(axis=1)
    touching = set(pairs[own].ravel().tolist()) - geoms[one]
    constraints = [c for grasp in block.grasps for c in grasp.constraints]
    if (
        constraints
        and grasps.held(np.asarray(physics.bind(constraints).active)).any()
    ):
      found[one] = 'held'
    elif touching & avatar:
      found[one] = 'touched'
    elif touching & others:
      found[one] = 'hit'
  return found
