"""Recorded episodes, from which learners are trained without acting.

Only the agent's folder of an export is read, and the manifest beside it, so the
truth may be elsewhere. `docs/doors.md` describes them. The manifest says where
the episodes are from: agents could conclude from it what the truth is, so it is
outside of their folder.
"""

from collections.abc import Mapping
import dataclasses
import json
import pathlib
from typing import TYPE_CHECKING, Any, final

import dm_env
from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite import errors
from realab_suite import worlds
from realab_suite.engine import batch_environment
from realab_suite.engine import batch_time_steps
from realab_suite.engine import environment
from realab_suite.feedback import specs
from realab_suite.lab.experiments import requirements
from realab_suite.lab.experiments import storage

if TYPE_CHECKING:
  import pyarrow as pa

FILE = 'steps.parquet'
"""Name of the file in the agent's folder of an export."""
MANIFEST = 'manifest.json'
"""Name of the file beside that folder, for those who train and judge."""

_Environment = environment.Environment | batch_environment.BatchEnvironment
_FIRST, _LAST = int(dm_env.StepType.FIRST), int(dm_env.StepType.LAST)


@final
class RecordedBatch:
  """Recorded episodes as a batch of worlds in which others have acted.

  All episodes are laid end to end. Worlds begin at steps that are spread over
  them evenly, read on from there, and begin again after the last one.
  """

  def __init__(
      self, columns: Mapping[str, np.ndarray], env: _Environment, num_envs: int
  ) -> None:
    """Makes a batch; `load` reads one from a file.

    Args:
      columns: Arrays of all episodes, one after the other, `(rows, ...)`:
        `step_type`, `discount`, `action` and observations by name.
      env: Environment whose specs they have.
      num_envs: Number of worlds.
    """
    self.num_envs = num_envs
    self._columns = columns
    self._specs = env.observation_spec(), env.action_spec()
    self._num_rows = len(columns['step_type'])
    self._starts = np.arange(num_envs) * self._num_rows // num_envs

  def observation_spec(self) -> dict[str, dm_env_specs.Array]:
    """Returns the observation spec of one world."""
    return self._specs[0]

  def action_spec(self) -> dm_env_specs.Array:
    """Returns the action spec of one world."""
    return self._specs[1]

  def at(
      self, number: int
  ) -> tuple[batch_time_steps.BatchTimeStep, np.ndarray]:
    """Returns a time step, and the actions that followed it.

    Args:
      number: Number of the time step, from 0 on without an end.

    Returns:
      The time step, and `(worlds, *action_spec.shape)`: 0 at ends of episodes.
    """
    rows = (self._starts + number) % self._num_rows
    taken = {name: column[rows] for name, column in self._columns.items()}
    action = taken.pop('action')
    time_step = batch_time_steps.BatchTimeStep(
        step_type=taken.pop('step_type'),
        reward=np.zeros(self.num_envs),
        discount=taken.pop('discount'),
        observation=taken,
    )
    return time_step, action


def load(folder: str, env: _Environment, num_envs: int) -> RecordedBatch:
  """Reads recorded episodes.

  Args:
    folder: Folder `agent` of an export.
    env: Environment of the design that the learner will act in.
    num_envs: Number of worlds of the batch.

  Raises:
    ResultsError: If pyarrow is missing, the file is missing or damaged, or the
      design has other observations or actions.
  """
  if problem := requirements.missing('pyarrow', extra='data'):
    raise errors.ResultsError(f'cannot read recorded episodes: {problem}')
  from pyarrow import parquet

  file = _file(folder)
  spec_of = {**env.observation_spec(), 'action': env.action_spec()}
  with storage.explained(file):
    try:
      table = parquet.read_table(file, partitioning=None)
      _check(file, table.schema, spec_of, env.mechanism.design)
      shapes = {name: spec.shape for name, spec in spec_of.items()}
      shapes |= {'step_type': (), 'discount': ()}
      columns = {k: _values(table.column(k), shapes[k]) for k in shapes}
      _check_known(file, table, columns['step_type'])
      is_finite = {k: np.isfinite(values) for k, values in columns.items()}
    except errors.RealabError:
      raise
    except Exception as error:  # Of pyarrow, or of NumPy on other types.
      text = ' '.join(str(error).split())
      raise errors.ResultsError(
          f'{file}: not the file of an export: {text:.120}'
      ) from error
  bounds: dict[str, Any] = {name: (-np.inf, np.inf) for name in columns}
  bounds['action'] = tuple(
      getattr(spec_of['action'], end, value)
      for end, value in (('minimum', -np.inf), ('maximum', np.inf))
  )
  bounds |= {'discount': (0.0, 1.0), 'step_type': (_FIRST, _LAST)}
  for name, (low, high) in bounds.items():
    values = columns[name]
    is_fine = is_finite[name] & (low <= values) & (values <= high)
    if not is_fine.all():
      raise errors.ResultsError(
          f'{file}: column {name!r} holds {values[~is_fine][0]}; must be'
          f' finite numbers from {low} to {high}'
      )
  is_first, is_last = (columns['step_type'] == one for one in (_FIRST, _LAST))
  # The last step of an episode stands before the first one of the next.
  if not (len(is_first) and (is_first == np.roll(is_last, 1)).all()):
    raise errors.ResultsError(
        f'{file}: {len(is_first)} steps; must hold whole episodes, one after'
        ' the other, and at least one'
    )
  columns['discount'][is_first] = 1.0
  return RecordedBatch(columns, env, num_envs)


def digest(folder: str, world: worlds.World, design: specs.DesignSpec) -> str:
  """Returns the SHA-256 of the file in a folder, as for `load`.

  Args:
    folder: Folder `agent` of an export.
    world: World that the learner will act in.
    design: Design that it will act in. Only the learner may be another one.

  Raises:
    ResultsError: If a file is missing, cannot be read or has changed, or the
      episodes are of another world, length, design or channel.
  """
  file = _file(folder)
  path = file.absolute().parent.with_name(MANIFEST)
  if not path.is_file():
    raise errors.ResultsError(
        f'{path}: missing, so nothing tells where {file} is from; export the'
        ' episodes again'
    )
  content = storage.read_json(path)
  with storage.fitting(path):
    written, origins = content[storage.FILES][FILE], content['origins']
    found = storage.imprint(file, written['records']) or {}
    storage.check_imprint(file, written, found)
    here = origin(world, design)
    for there in origins or [{}]:
      if there != here:
        raise errors.ResultsError(
            f'{file}: recorded elsewhere than where its learner is judged:'
            f' {storage.difference(there, here)}'
        )
    return str(found['sha256'])


def origin(world: worlds.World, design: specs.DesignSpec) -> dict[str, Any]:
  """Returns the facts that recorded episodes and their use have in common.

  Args:
    world: The world.
    design: The design. Other learners may use its episodes.
  """
  mapping = design.to_mapping()
  for key in ('name', 'description', 'learner'):
    mapping.pop(key, None)
  of_world = {**dataclasses.asdict(world), 'senses': None}  # Columns have them.
  plain = json.dumps({**of_world, 'channel': design.channel, 'design': mapping})
  origin_of: dict[str, Any] = json.loads(plain)
  return origin_of


def array_field(name: str, spec: dm_env_specs.Array) -> 'pa.Field':
  """Returns the column of an observation, or of actions, which may be missing.

  An array becomes a list of fixed size.
  """
  import pyarrow as pa

  kind = pa.from_numpy_dtype(spec.dtype)
  if spec.shape:
    kind = pa.list_(kind, int(np.prod(spec.shape)))
  metadata = {'shape': json.dumps(list(spec.shape))}
  if spec.name and name == 'action':
    metadata['names'] = json.dumps(spec.name.split('\t'))
  if isinstance(spec, dm_env_specs.BoundedArray):
    metadata['minimum'] = json.dumps(np.asarray(spec.minimum).tolist())
    metadata['maximum'] = json.dumps(np.asarray(spec.maximum).tolist())
  return pa.field(name, kind, name == 'action', metadata)


def _file(folder: str) -> pathlib.Path:
  file = pathlib.Path(folder) / FILE
  if not file.is_file():
    raise errors.ResultsError(
        f"{file}: missing; must be the folder 'agent' of an export in the"
        ' format parquet'
    )
  return file


def _check(
    file: pathlib.Path,
    schema: 'pa.Schema',
    spec_of: Mapping[str, dm_env_specs.Array],
    design: specs.DesignSpec,
) -> None:
  """Checks that episodes have the observations and actions of a design.

  Nothing else of a design can be checked: the agent's file does not name it.

  Raises:
    ResultsError: If not.
  """
  columns = {one.name: _words(one) for one in schema if '/' in one.name}
  columns |= {one.name: _words(one) for one in schema if one.name in spec_of}
  needed = {name: _words(array_field(name, spec_of[name])) for name in spec_of}
  for name in sorted(columns.keys() | needed.keys()):
    words, allowed = (one.get(name, 'missing') for one in (columns, needed))
    if words != allowed:
      raise errors.ResultsError(
          f'{file}: column {name!r}: {words}; with {design.name!r}: {allowed}'
      )


def _check_known(
    file: pathlib.Path, table: 'pa.Table', step_type: np.ndarray
) -> None:
  """Refuses gaps: a missing action or reading would count as 0.

  Raises:
    ResultsError: If anything is missing but actions after episodes, and
      discounts and rewards at their starts.
  """
  may_lack = {'action': _LAST, 'discount': _FIRST, 'observed_reward': _FIRST}
  for name in table.column_names:
    is_known = table.column(name).is_valid().to_numpy()
    lacks = ~is_known & (step_type != may_lack.get(name, -1))
    if lacks.any():
      raise errors.ResultsError(
          f'{file}: column {name!r} has no value in {lacks.sum()} of'
          f' {len(lacks)} steps; must have one in each'
      )


def _words(column: 'pa.Field') -> str:
  """Returns the type of a column, and its metadata that its spec determines."""
  meta = column.metadata or {}
  keys = (b'shape', b'names', b'minimum', b'maximum')
  parts = [f'{k.decode()} {meta[k].decode()}' for k in keys if k in meta]
  return ', '.join(
      [str(getattr(column.type, 'value_type', column.type)), *parts]
  )


def _values(column: Any, shape: tuple[int, ...]) -> np.ndarray:
  """Returns the values of a column, `(rows, *shape)`, and 0 if missing."""
  is_known = column.is_valid().to_numpy()
  array = column.drop_null().combine_chunks()
  flat = (array.flatten() if shape else array).to_numpy(zero_copy_only=False)
  values = np.zeros((len(is_known), *shape), flat.dtype)
  values[is_known] = flat.reshape(-1, *shape)
  return values
