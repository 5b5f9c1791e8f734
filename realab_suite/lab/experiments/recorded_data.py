"""Recorded episodes, from which learners are trained without acting.

Only the agent's folder of an export is read, so the truth may be elsewhere.
`docs/doors.md` describes it.
"""

from collections.abc import Mapping
import hashlib
import json
import pathlib
from typing import TYPE_CHECKING, Any, final

import dm_env
from dm_env import specs as dm_env_specs
import numpy as np

from realab_suite import errors
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
  import pyarrow as pa
  from pyarrow import parquet

  file = _file(folder)
  spec_of = {**env.observation_spec(), 'action': env.action_spec()}
  with storage.explained(file):
    try:
      table = parquet.read_table(file)
      _check(file, table.schema, spec_of, env.mechanism.design)
      shapes = {name: spec.shape for name, spec in spec_of.items()}
      shapes |= {'step_type': (), 'discount': ()}
      columns = {k: _values(table.column(k), shapes[k]) for k in shapes}
    except (pa.ArrowException, KeyError) as error:
      text = ' '.join(str(error).split())
      raise errors.ResultsError(
          f'{file}: not the file of an export: {text:.120}'
      ) from error
  bounds: dict[str, Any] = {name: (-np.inf, np.inf) for name in columns}
  bounds['action'] = tuple(
      getattr(spec_of['action'], end, value)
      for end, value in (('minimum', -np.inf), ('maximum', np.inf))
  )
  bounds['discount'] = 0.0, 1.0
  for name, (low, high) in bounds.items():
    values = columns[name]
    is_fine = np.isfinite(values) & (low <= values) & (values <= high)
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


def digest(folder: str) -> str:
  """Returns the SHA-256 of the file in a folder, as for `load`.

  Raises:
    ResultsError: If the file is missing or cannot be read.
  """
  path = _file(folder)
  with storage.explained(path), open(path, 'rb') as file:
    return hashlib.file_digest(file, 'sha256').hexdigest()


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
