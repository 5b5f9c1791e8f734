"""Snapshots: everything that the future of a world depends on, as plain data.

The state of an episode is physical, so most of it is one array of MuJoCo's. The
rest are numbers, texts and arrays in nested containers. `archive.py` turns them
into bytes.
"""

from collections.abc import Callable, Mapping, Sequence
import hashlib
from typing import Any, NamedTuple, Self, final

from dm_control import mjcf
import mujoco
import numpy as np

from realab_suite import archive
from realab_suite import errors
from realab_suite.engine import seeding
from realab_suite.entities import state

_WHAT = 'snapshot'
# Entry of a snapshot of worlds whose seeds are salted.
_SALTS = 'salts'
# Its name in snapshots of version 0.1.
_INDICES = 'places'
_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION


@final
class Snapshot:
  """A world at one moment, and a header that says where it fits.

  It never changes, and can be restored any number of times.
  """

  def __init__(self, header: Mapping[str, Any], contents: Any) -> None:
    """Takes a copy of `contents`.

    Args:
      header: What an environment has to have in common with the one that was
        saved; JSON.
      contents: Tuples, lists and dicts of arrays, numbers, texts and `None`.

    Raises:
      StateLayoutError: If something else is among the contents.
    """
    self._archive = archive.Archive(header, contents)

  @property
  def header(self) -> dict[str, Any]:
    """Where the snapshot fits; a copy."""
    return self._archive.header

  def contents_for(self, header: Mapping[str, Any]) -> Any:
    """Returns a copy of the contents, for an environment that they fit.

    Args:
      header: The environment's own.

    Raises:
      StateLayoutError: If the headers differ; the message names where.
    """
    differing = self._archive.differences(header, 'in the snapshot', 'here')
    if differing:
      raise errors.StateLayoutError(
          f'the snapshot does not fit this environment: {differing}'
      )
    return self._archive.contents()

  def to_bytes(self) -> bytes:
    """Returns the snapshot for a file or another process."""
    return self._archive.to_bytes()

  @classmethod
  def from_bytes(cls, data: bytes) -> Self:
    """Returns the snapshot that `to_bytes` was called on.

    Raises:
      StateLayoutError: If the bytes are damaged, of another format, or of
        something else than a snapshot.
    """
    read = archive.Archive.from_bytes(data, _WHAT)
    if read.what != _WHAT:
      raise errors.StateLayoutError(
          f'the archive holds {read.what!r:.40}; expected a {_WHAT} of worlds'
      )
    return cls(read.header, read.contents())


@final
class WorldStates(NamedTuple):
  """What snapshots have in them: some worlds, each whole.

  Attributes:
    indices: Where in a batch each world was; `None` for a world alone.
    physics: The integration states, `(worlds, size)`.
    seed: Of each world; what its random streams follow from.
    world: The number of each, which they follow from, too.
    episode: The number of each world's episode, -1 before the first.
    is_pending: Whether the next step of each begins an episode.
    is_open: Whether the sinks of each are waiting for the end of an episode.
    provider_keys: The keys of each provider, `(worlds, 2)`.
    provider_states: Of a batch, trees of arrays, `(worlds, ...)`; of a world
      alone, as its providers returned them.
    observation: By name, each `(worlds, ...)`; empty before the first episode.
    sinks: For each sink, its kind and what it knows of each world.
    random_state: The generator; `None` where there is none, as in a batch.
  """

  indices: list[int] | None
  physics: np.ndarray
  seed: list[int]
  world: list[int]
  episode: list[int]
  is_pending: list[bool]
  is_open: list[bool]
  provider_keys: list[np.ndarray]
  provider_states: list[Any]
  observation: dict[str, np.ndarray]
  sinks: list[Any]
  random_state: dict[str, Any] | None

  @classmethod
  def from_data(cls, data: Mapping[str, Any]) -> Self:
    """Returns the worlds that `to_data` was called on."""
    fields = dict(data)
    fields['indices'] = fields.pop(_INDICES)
    salts = fields.pop(_SALTS, None)
    if salts is not None:
      fields['seed'] = [
          seeding.SaltedSeed(seed, bytes.fromhex(salt)) if salt else seed
          for seed, salt in zip(fields['seed'], salts, strict=True)
      ]
    return cls(**fields)

  def to_data(self) -> dict[str, Any]:
    """Returns the worlds as plain data; a salted seed comes with its salt."""
    data = {**self._asdict(), 'seed': [int(seed) for seed in self.seed]}
    data[_INDICES] = data.pop('indices')
    salts = [
        seed.salt.hex() if isinstance(seed, seeding.SaltedSeed) else None
        for seed in self.seed
    ]
    if any(salts):
      data[_SALTS] = salts
    return data

  def refuse_other_sinks(self, kinds: list[str]) -> None:
    """Refuses sinks that would miss how the episodes under way began.

    Args:
      kinds: What listens where the worlds are to go on.

    Raises:
      StateLayoutError: If there are sinks, and others than were saved.
    """
    saved = [kind for kind, _ in self.sinks]
    if kinds and kinds != saved:
      raise errors.StateLayoutError(
          f'the snapshot was saved with sinks {saved}; this environment has'
          f' {kinds}; allowed are the same ones, or none here'
      )

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
      rows: The saved world that each of them gets.

    Raises:
      StateLayoutError: If the snapshot does not fit.
    """
    saved: Any = self.provider_states
    if self.indices is None:
      saved = of_batch(saved)
    merged = [
        merge(f'the state of providers[{i}]', here, indices, there)
        for i, (here, there) in enumerate(
            zip(states, spread(saved, rows), strict=True)
        )
    ]
    seen = spread(self.observation, rows)
    if observation:
      seen = merge('observation', observation, indices, seen)
    return merged, seen


def of_batch(tree: Any) -> Any:
  """Returns a tree of one world's values as that of a batch of one."""
  return _map(lambda value: np.asarray(value)[np.newaxis], tree)


def of_world(tree: Any) -> Any:
  """Returns the tree of a batch of one as that of a world alone."""
  return _map(lambda value: np.array(value[0])[()], tree)


def spread(tree: Any, rows: np.ndarray) -> Any:
  """Returns a tree of arrays with these of their rows, in this order."""
  return _map(lambda value: value[rows], tree)


def merge(where: str, tree: Any, indices: np.ndarray, saved: Any) -> Any:
  """Returns a tree of arrays whose rows at some indices are others.

  Args:
    where: What to call the tree in a message.
    tree: The tree; it is not written to.
    indices: The rows.
    saved: A tree with as many rows as there are indices.

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
  # Rows that stay have the last word on the type of numbers.
  is_whole = len(indices) == len(tree) and not saved.dtype.hasobject
  is_like = is_whole or tree.dtype == saved.dtype
  if not is_like or tree.shape[1:] != saved.shape[1:]:
    raise _misfit(where, *(f'{x.dtype} {x.shape[1:]}' for x in (saved, tree)))
  merged = np.empty_like(saved) if is_whole else np.array(tree)
  merged[indices] = saved
  return merged


def describe(model: Any) -> dict[str, Any]:
  """Returns what a snapshot's header says of a compiled model.

  Args:
    model: The model, as `physics.model`.

  Raises:
    SpecError: If MuJoCo keeps some of the state where nobody can get at it.
  """
  if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
    raise errors.SpecError(
        'a world whose bodies fall asleep cannot be saved or restored: MuJoCo'
        ' does not give away who sleeps; allowed is sleep off'
    )
  compiled = np.empty(mujoco.mj_sizeModel(model.ptr), np.uint8)
  mujoco.mj_saveModel(model.ptr, None, compiled)
  return {
      'mujoco': mujoco.__version__,
      'model': hashlib.sha256(compiled.tobytes()).hexdigest()[:16],
      'slots': state.layout(model),
  }


def get_state(physics: mjcf.Physics) -> np.ndarray:
  """Returns all of the physics that the future depends on."""
  model, data = physics.model.ptr, physics.data.ptr
  values = np.empty(mujoco.mj_stateSize(model, _INTEGRATION))
  mujoco.mj_getState(model, data, values, _INTEGRATION)
  return values


def set_state(physics: mjcf.Physics, values: np.ndarray) -> None:
  """Does the opposite of `get_state`, and brings up to date what derives."""
  model, data = physics.model.ptr, physics.data.ptr
  # Warnings of what went on here before say nothing about what is restored.
  mujoco.mj_resetData(model, data)
  mujoco.mj_setState(model, data, values, _INTEGRATION)
  physics.forward()


def _map(function: Callable[[Any], Any], tree: Any) -> Any:
  """Returns a tree of what a function makes of the values in another one."""
  if isinstance(tree, dict):
    return {key: _map(function, value) for key, value in tree.items()}
  if isinstance(tree, tuple | list):
    return type(tree)(_map(function, value) for value in tree)
  return function(tree)


def _misfit(where: str, saved: Any, here: Any) -> errors.StateLayoutError:
  return errors.StateLayoutError(
      'the snapshot does not fit this environment:'
      f' {where} is {saved!s:.60} in the snapshot, {here!s:.60} here'
  )
