"""Snapshots: complete states of worlds, as plain data.

The state of an episode is physical, so one array from MuJoCo contains most of
it. The rest consists of numbers, strings and arrays in nested containers.
`archive.py` converts them to bytes.
"""

from collections.abc import Mapping, Sequence
import hashlib
from typing import Any, NamedTuple, Self, final

from dm_control import composer
from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import archive
from realab_suite import errors
from realab_suite import trees
from realab_suite.config import messages
from realab_suite.engine import arguments
from realab_suite.entities import state
from realab_suite.tasks import base

_KIND = 'snapshot'
# Version of the contents. Since version 2, states of providers are those of
# `clean_contents`; since version 3, seeds have no salts; since version 4, sinks
# have no states, and indices have this name.
_VERSION = 4
_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION


@final
class Snapshot:
  """The states of worlds, and a header that describes their environment.

  A snapshot is immutable and can be restored any number of times.
  """

  def __init__(self, header: Mapping[str, Any], contents: Any) -> None:
    """Copies the contents.

    Args:
      header: Properties that an environment needs to have for this snapshot, as
        JSON values.
      contents: Tuples, lists and dicts of arrays, numbers, strings and `None`.

    Raises:
      StateLayoutError: If the contents include another type.
    """
    self._archive = archive.Archive(header, contents)

  @property
  def header(self) -> dict[str, Any]:
    """Copy of the header."""
    return self._archive.header

  def contents_for(self, header: Mapping[str, Any]) -> Any:
    """Returns a copy of the contents if an environment has the same header.

    Args:
      header: Header of the environment.

    Raises:
      StateLayoutError: If the headers differ; the message names the entries.
    """
    differing = self._archive.differences(header, 'in the snapshot', 'here')
    if differing:
      raise errors.StateLayoutError(
          f'the snapshot does not fit this environment: {differing}'
      )
    return self._archive.contents()

  def to_bytes(self) -> bytes:
    """Returns the snapshot as bytes, for a file or another process."""
    return self._archive.to_bytes()

  @classmethod
  def from_bytes(cls, data: bytes) -> Self:
    """Returns a snapshot from the result of `to_bytes`.

    Raises:
      StateLayoutError: If the bytes are damaged, have another format, or do not
        contain a snapshot.
    """
    read = archive.Archive.from_bytes(data, _KIND)
    if read.what != _KIND:
      raise errors.StateLayoutError(
          f'the archive contains {read.what!r:.40}; expected a {_KIND}'
      )
    return cls(read.header, read.contents())


@final
class WorldStates(NamedTuple):
  """Contents of a snapshot, by name: the complete states of worlds.

  Attributes:
    indices: Index of each world in its batch; `None` for a single world.
    physics: Integration states, `(worlds, size)`.
    seed: Seed of each world. Its random streams depend on it.
    world: Number of each world. Its random streams depend on it as well.
    episode: Number of each world's episode; -1 before the first.
    is_pending: True for worlds whose next step begins an episode.
    provider_keys: Random keys of each provider, `(worlds, 2)` uint64.
    provider_states: State of each provider. For a batch, these are trees of
      arrays `(worlds, ...)`; for a single world, the states as returned.
    observation: Arrays `(worlds, ...)`, by name; empty before the first
      episode.
    random_state: State of the generator for hooks; `None` for a batch, which
      has none.
  """

  indices: list[int] | None
  physics: np.ndarray
  seed: list[int]
  world: list[int]
  episode: list[int]
  is_pending: list[bool]
  provider_keys: list[np.ndarray]
  provider_states: list[Any]
  observation: dict[str, np.ndarray]
  random_state: dict[str, Any] | None

  @classmethod
  def from_snapshot(cls, snapshot: Any, header: Mapping[str, Any]) -> Self:
    """Returns the states of worlds from a snapshot that fits an environment.

    Args:
      snapshot: What a caller wants to restore.
      header: Header of the environment.

    Raises:
      StateLayoutError: If it is no snapshot, or the headers differ.
    """
    if not isinstance(snapshot, Snapshot):
      raise errors.StateLayoutError(
          f'snapshot: {messages.quote(snapshot)}; must be a Snapshot, as'
          ' from `save` or `Snapshot.from_bytes`'
      )
    return cls(**snapshot.contents_for(header))

  def provider_states_of_world(self) -> list[Any]:
    """Returns the states of the providers of the only saved world."""
    if self.indices is None:
      return self.provider_states
    states: list[Any] = of_world(self.provider_states)
    return states

  def observation_of_world(self) -> dict[str, np.ndarray]:
    """Returns the observation of the only saved world, as copies."""
    return {key: np.array(v[0]) for key, v in self.observation.items()}

  def indices_for(
      self, worlds: Sequence[int] | None, num_envs: int
  ) -> np.ndarray:
    """Returns the indices of the worlds of a batch to restore.

    Args:
      worlds: Chosen indices; `None` for the saved ones.
      num_envs: Number of worlds of the batch.

    Raises:
      SpecError: If an index is invalid.
      StateLayoutError: If there are not as many worlds in the snapshot, or if
        it is of a single world and none are chosen.
    """
    if worlds is None and self.indices is None:
      raise errors.StateLayoutError(
          'the snapshot is of a single world; pass the indices to restore, as'
          ' in restore(snapshot, worlds=[0])'
      )
    indices = arguments.indices(
        self.indices if worlds is None else worlds, num_envs
    )
    if len(self.seed) not in (1, len(indices)):
      raise errors.StateLayoutError(
          f'the snapshot has {len(self.seed)} worlds, for {len(indices)} here;'
          ' must have the same number, or one'
      )
    return indices

  def merged_into(
      self,
      states: Sequence[Any],
      observation: dict[str, np.ndarray],
      indices: np.ndarray,
      rows: np.ndarray,
  ) -> tuple[list[Any], dict[str, np.ndarray]]:
    """Returns a batch's provider states and observation with worlds restored.

    Args:
      states: State of each provider of the batch.
      observation: Observation of the batch; empty before its first episode.
      indices: Indices in the batch of the worlds to restore.
      rows: Saved world for each of them, as an index in this snapshot.

    Returns:
      The new state of each provider, and the new observation.

    Raises:
      StateLayoutError: If the snapshot does not fit.
    """
    saved: Any = self.provider_states
    if self.indices is None:
      saved = of_batch(saved)
    merged = [
        merge(f'the state of providers[{i}]', here, indices, there)
        for i, (here, there) in enumerate(
            zip(states, trees.taken(saved, rows), strict=True)
        )
    ]
    arrays = trees.taken(self.observation, rows)
    if observation:
      arrays = merge('observation', observation, indices, arrays)
    return merged, arrays


def of_batch(tree: Any) -> Any:
  """Adds a leading axis of length one to all values of a tree."""
  return trees.mapped(lambda value: np.asarray(value)[np.newaxis], tree)


def of_world(tree: Any) -> Any:
  """Removes the leading axis of length one from all arrays of a tree."""
  return trees.mapped(lambda value: np.array(value[0])[()], tree)


def merge(where: str, tree: Any, indices: np.ndarray, saved: Any) -> Any:
  """Returns a copy of a tree of arrays with some rows replaced.

  Args:
    where: Name of the tree in messages.
    tree: Tree of arrays. It is not changed.
    indices: Rows to replace.
    saved: Tree of arrays with the new rows, one for each index.

  Raises:
    StateLayoutError: If the trees differ in anything but the number of rows.
  """
  if type(tree) is not type(saved):
    raise _misfit(where, type(saved).__name__, type(tree).__name__)
  if isinstance(tree, dict):
    if tree.keys() != saved.keys():
      raise _misfit(where, sorted(saved), sorted(tree))
    return {
        key: merge(f'{where}[{key!r}]', value, indices, saved[key])
        for key, value in tree.items()
    }
  if isinstance(tree, tuple | list):
    if len(tree) != len(saved):
      raise _misfit(where, f'of length {len(saved)}', f'of {len(tree)}')
    return type(tree)(
        merge(f'{where}[{i}]', value, indices, saved[i])
        for i, value in enumerate(tree)
    )
  # A new dtype is possible only if all rows are replaced.
  is_whole = len(indices) == len(tree) and not saved.dtype.hasobject
  is_like = is_whole or tree.dtype == saved.dtype
  if not is_like or tree.shape[1:] != saved.shape[1:]:
    raise _misfit(where, *(f'{x.dtype} {x.shape[1:]}' for x in (saved, tree)))
  merged = np.empty_like(saved) if is_whole else np.array(tree)
  merged[indices] = saved
  return merged


def replaced(old: np.ndarray, indices: np.ndarray, values: Any) -> np.ndarray:
  """Returns a copy of an array with the elements at some indices replaced."""
  copy = np.array(old)
  copy[indices] = values
  return copy


def describe(task: composer.Task, model: Any) -> dict[str, Any]:
  """Returns the entries of a snapshot's header that describe a world.

  Args:
    task: Its task.
    model: Compiled model, as `physics.model`.

  Raises:
    SpecError: If the task is foreign, or if bodies can sleep, because MuJoCo
      does not export which do.
  """
  if not isinstance(task, base.Task):
    raise errors.SpecError(
        f'{type(task).__name__} cannot be saved or restored: only a'
        ' realab_suite.tasks.base.Task is compiled once and keeps no state in'
        ' Python'
    )
  if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
    raise errors.SpecError(
        'a world whose bodies can sleep cannot be saved or restored: MuJoCo'
        ' does not export which bodies sleep; load it with sleep=False'
    )
  compiled = np.empty(mujoco.mj_sizeModel(model.ptr), np.uint8)
  mujoco.mj_saveModel(model.ptr, None, compiled)
  return {
      'version': _VERSION,
      'mujoco': mujoco.__version__,
      'model': hashlib.sha256(compiled.tobytes()).hexdigest()[:16],
      'slots': state.layout(model),
      'task': type(task).__name__,
      'dynamics': task.DYNAMICS_VERSION,
  }


def get_state(physics: mjcf.Physics) -> np.ndarray:
  """Returns the integration state of a physics, `(size,)`."""
  model, data = physics.model.ptr, physics.data.ptr
  values = np.empty(mujoco.mj_stateSize(model, _INTEGRATION))
  mujoco.mj_getState(model, data, values, _INTEGRATION)
  return values


def set_state(physics: mjcf.Physics, values: np.ndarray) -> None:
  """Sets the integration state of a physics and updates derived quantities."""
  model, data = physics.model.ptr, physics.data.ptr
  # Clears earlier warnings, which do not concern the restored state.
  mujoco.mj_resetData(model, data)
  mujoco.mj_setState(model, data, values, _INTEGRATION)
  physics.forward()


def _misfit(where: str, saved: Any, here: Any) -> errors.StateLayoutError:
  return errors.StateLayoutError(
      'the snapshot does not fit this environment:'
      f' {where} is {saved!s:.60} in the snapshot, {here!s:.60} here'
  )
