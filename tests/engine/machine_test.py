"""Stateful property test: an environment stays whole in any order of calls.

Hypothesis draws sequences of operations: a provider writes any number, blocks
are pushed, displaced or given a state that MuJoCo cannot simulate, episodes are
stepped, reset, abandoned and rewound, worlds are saved and restored.
"""

import collections
import math
from typing import Any, Literal, final

import dm_env
import hypothesis
from hypothesis import stateful
from hypothesis import strategies as st
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from realab_suite.feedback import providers
from tests import examples
from tests import worlds
from tests.engine import helpers
from tests.evaluation import streams

pytestmark = pytest.mark.mujoco_warns('BADQPOS', 'BADQVEL', 'BADQACC')

_NUM_OPERATIONS = 50
_TOLERANCE = 1e-9
_MAX_STEPS = 12
# Values that the provider writes next, by register.
_DICTATION: dict[str, Any] = {}
# Number of times that something happened, over all sequences.
_COUNTS: collections.Counter[str] = collections.Counter()


@final
class Dictated(providers.Provider):
  """Writes the values of `_DICTATION`."""

  kind: Literal['dictated'] = 'dictated'

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    return {name: _DICTATION.get(name, 0.0) for name in self.writes}, state


def _register(role: str, place: Any, **more: Any) -> dict[str, Any]:
  return {
      'kind': 'two_block', 'role': role, 'place': place, 'range': [-2, 12],
      **more,
  }  # fmt: skip


_DESIGN = {
    'schema': 1,
    'name': 'machine',
    'registers': {
        'reward': _register(
            'feedback', {'position': [-2.5, 2.6], 'yaw': 2.1}, scale=0.05
        ),
        'other': _register('feedback', 'station_2'),
        'query': _register('query', 'station_3', dof='planar'),
        'place': {**_register('signal', 'station_4'), 'kind': 'block_position'},
    },
    'providers': [
        {
            'kind': 'dictated',
            'reads': ['query'],
            'writes': ['reward', 'other', 'place'],
        }
    ],
}
_WRITTEN = ('reward', 'other', 'place')
_ANY_FLOAT = st.one_of(
    st.floats(-3, 13),
    st.floats(-3, 13),
    st.floats(),
    st.sampled_from(
        [math.nan, math.inf, -math.inf, 0.0, -0.0, 1e300, -1e300, 5e-324, 12.0]
    ),
)
_SEEDS = st.integers(0, 2**20)


def _load() -> Any:
  with helpers.registered(providers.PROVIDERS, 'dictated', Dictated):
    return suite.load(
        'unlock_door', 'near', {'random': 5}, {'max_steps': _MAX_STEPS},
        design=_DESIGN,
    )  # fmt: skip


def _along(env: Any, name: str) -> np.ndarray:
  """Returns the blocks of a register along its axis, in its units."""
  register = env.mechanism.registers[name]
  yaw = env.mechanism.design.registers[name].place
  yaw = 0.0 if isinstance(yaw, str) else yaw.yaw
  axis = np.array([math.cos(yaw), math.sin(yaw)])
  blocks = [env.physics.bind(block.geom).xpos[:2] for block in register.blocks]
  return np.array([block @ axis for block in blocks]) / register.scale


class Machine(stateful.RuleBasedStateMachine):
  """Operations on one environment, and conditions that hold after each."""

  snapshots = stateful.Bundle('snapshots')
  # Compiling takes longer than a whole sequence, so sequences share a world.
  _spare: Any = None

  def __init__(self) -> None:
    super().__init__()
    self._env = Machine._spare or _load()
    Machine._spare = None
    self._listen()
    self._env.rewind(0)

  def _listen(self) -> None:
    self._ledger = ledgers.Ledger()
    self._env.add_sink(self._ledger)
    self._num_checked = 0
    # True if the next step begins an episode.
    self._is_pending = True
    # True after a restore, until an episode begins.
    self._is_unheard = False

  def teardown(self) -> None:
    _DICTATION.clear()
    self._env.remove_sink(self._ledger)
    Machine._spare = self._env

  def act(self, action: Any) -> dm_env.TimeStep | None:
    """Takes a step; returns `None` if the provider's writes were refused."""
    was_pending = self._is_pending
    refuses = not was_pending and any(
        not math.isfinite(_DICTATION.get(name, 0.0)) for name in _WRITTEN
    )
    try:
      time_step = self._env.step(action)
    except errors.RegisterValueError as error:
      if not refuses or not str(error).isprintable():
        raise
      _COUNTS['refused writes'] += 1
      self._is_pending = True
      return None
    # The physics may fail before the provider writes.
    has_failed = self._ledger.last.end is events.End.DIVERGENCE
    assert has_failed or not refuses or self._is_unheard
    self._is_unheard &= not time_step.first()
    _COUNTS['unheard steps'] += self._is_unheard
    assert time_step.first() == was_pending
    assert (time_step.reward, time_step.discount) in (
        [(None, None)] if was_pending else [(0.0, 1.0), (0.0, 0.0)]
    )
    for key, number in time_step.observation.items():
      assert np.isfinite(number).all(), key
    self._is_pending = time_step.last()
    _COUNTS[f'steps, {time_step.step_type.name}'] += 1
    return time_step

  @stateful.rule(seed=_SEEDS)
  def step(self, seed: int) -> None:
    (action,) = helpers.random_actions(self._env, 1, seed)
    self.act(action)

  @stateful.rule(
      register=st.sampled_from(_WRITTEN), value=_ANY_FLOAT, seed=_SEEDS
  )
  def write(self, register: str, value: float, seed: int) -> None:
    _DICTATION[register] = value
    (action,) = helpers.random_actions(self._env, 1, seed)
    time_step = self.act(action)
    if time_step is not None and time_step.mid() and not self._is_unheard:
      (last,) = [
          entry
          for entry in self._ledger.last.entries[register][-4:]
          if isinstance(entry, registers.Write)
          and entry.step == self._ledger.last.num_steps
      ][-1:]
      assert last.requested == value
      assert last.applied == np.clip(value, -2.0, 12.0)
      _COUNTS['writes'] += 1
    _DICTATION.clear()

  @stateful.rule(action=st.sampled_from(
      [None, 'x', math.nan, [math.nan] * 7, [1e9] * 7, [0.0] * 6, [True] * 7]
  ))  # fmt: skip
  def send_nonsense(self, action: Any) -> None:
    before = worlds.state_bytes(self._env.physics)
    try:
      self._env.step(action)
    except errors.ActionError:
      _COUNTS['refused actions'] += 1
    else:
      raise AssertionError(f'{action!r} was accepted')
    assert worlds.state_bytes(self._env.physics) == before

  @stateful.rule(seed=_SEEDS, speed=st.floats(0, 8))
  def push(self, seed: int, speed: float) -> None:
    """Gives every block some velocity."""
    velocities = self._env.physics.data.qvel
    noise = np.random.default_rng(seed).normal(size=velocities.shape)
    velocities += speed * noise
    _COUNTS['pushes'] += 1
    self.step(seed)

  @stateful.rule(
      seed=_SEEDS, value=st.sampled_from([math.nan, math.inf, 1e11, 1e300])
  )
  def wreck(self, seed: int, value: float) -> None:
    """Sets a velocity that cannot be simulated."""
    if self._is_pending:
      return
    velocities = self._env.physics.data.qvel
    velocities[seed % len(velocities)] = value
    time_step = self.act(helpers.random_actions(self._env, 1, seed)[0])
    assert time_step is not None
    if np.isfinite(self._env.physics.data.qvel).all() and time_step.mid():
      # The query moved this very block, and a write puts it to rest.
      return
    assert time_step.last()
    assert time_step.discount == 1.0
    if not self._is_unheard:
      assert self._ledger.last.end is events.End.DIVERGENCE
    _COUNTS['divergences'] += 1

  @stateful.rule(
      register=st.sampled_from(sorted(_DESIGN['registers'])),
      shift=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
      heading=st.floats(-1, 1),
      is_base=st.booleans(),
  )
  def displace(
      self, register: str, shift: Any, heading: float, is_base: bool
  ) -> None:
    """Moves a block, and compares its register with the block's way."""
    # Draws depend on all modules that are imported, whose constants Hypothesis
    # takes up. Without this line, it may happen that no base block is moved.
    if self._is_pending:
      self.reset()
    env = self._env
    before = _along(env, register)
    was = env.mechanism.registers[register].inspect(env.physics)
    blocks = env.mechanism.registers[register].blocks
    block = blocks[0 if is_base else -1]
    position = np.array(block.position(env.physics))
    position[:2] += shift
    block.put(env.physics, position, heading=heading)
    env.physics.forward()
    moved = _along(env, register) - before
    now = env.mechanism.registers[register].inspect(env.physics)
    permanent = -moved[0] if len(blocks) > 1 else 0.0
    limit = _TOLERANCE * 1e3
    assert abs(now.permanent - was.permanent - permanent) <= limit
    assert abs(now.temporary - was.temporary - moved[-1]) <= limit
    _COUNTS['displacements'] += 1

  @stateful.rule()
  def read(self) -> None:
    before = worlds.state_bytes(self._env.physics)
    for read in worlds.shadow_reads(
        self._env.mechanism, self._env.physics, 'machine'
    ):
      register = self._env.mechanism.registers[read.register]
      applied = register.applied(self._env.physics)
      corruption = read.obstruction + read.permanent + read.temporary
      assert abs(read.reading - applied - corruption) <= _TOLERANCE
    assert worlds.state_bytes(self._env.physics) == before
    _COUNTS['reads'] += 1

  @stateful.rule()
  def reset(self) -> None:
    is_open = self._has_open_episode()
    number = len(self._ledger.episodes)
    assert self._env.reset().first()
    if is_open:
      assert self._ledger.episodes[number - 1].end is events.End.ABANDONED
      _COUNTS['abandoned'] += 1
    self._is_pending = self._is_unheard = False

  @stateful.rule(episode=st.integers(0, 3))
  def rewind(self, episode: int) -> None:
    is_open = self._has_open_episode()
    self._env.rewind(episode)
    if is_open:
      assert self._ledger.last.end is events.End.ABANDONED
    self._is_pending = True
    _COUNTS['rewinds'] += 1

  @stateful.rule(target=snapshots)
  def save(self) -> Any:
    before = worlds.state_bytes(self._env.physics)
    snapshot = self._env.save()
    assert worlds.state_bytes(self._env.physics) == before
    return snapshot, self._is_pending

  @stateful.rule(saved=snapshots)
  def restore(self, saved: Any) -> None:
    snapshot, is_pending = saved
    is_open = self._has_open_episode()
    self._env.restore(snapshot)
    if is_open:
      assert self._ledger.last.end is events.End.ABANDONED
    assert self._env.save().to_bytes() == snapshot.to_bytes()
    self._is_pending, self._is_unheard = is_pending, True
    _COUNTS['restored'] += 1

  @stateful.invariant()
  def bodies_are_finite(self) -> None:
    data = self._env.physics.data
    for name in ('qpos', 'qvel', 'xpos', 'userdata'):
      assert np.isfinite(getattr(data, name)).all(), name
    assert np.abs(data.qpos).max() < 1e3

  @stateful.invariant()
  def readings_add_up(self) -> None:
    """Checks the episodes that are new, or have grown."""
    episodes = self._ledger.episodes
    for write, read in streams.pairs(episodes[self._num_checked :]):
      saturation = write.applied - write.requested
      error = read.reading - write.requested - (
          saturation + read.obstruction + read.permanent + read.temporary
      )  # fmt: skip
      # A request of 1e300 is saturated by as much, to the last bit of that.
      assert abs(error) <= _TOLERANCE * max(1.0, abs(write.requested))
      _COUNTS['readings'] += 1
    self._num_checked = max(0, len(episodes) - 1)

  @stateful.invariant()
  def only_the_last_episode_is_open(self) -> None:
    episodes = self._ledger.episodes
    assert all(episode.end is not None for episode in episodes[:-1])
    if episodes and not self._is_pending:
      assert (episodes[-1].end is None) != self._is_unheard

  def _has_open_episode(self) -> bool:
    episodes = self._ledger.episodes
    return bool(episodes) and episodes[-1].end is None


_REACHED = (
    'steps, FIRST', 'steps, MID', 'steps, LAST', 'writes', 'refused writes',
    'refused actions', 'pushes', 'displacements', 'divergences', 'reads',
    'abandoned', 'rewinds', 'restored', 'unheard steps', 'readings',
)  # fmt: skip


def _run(number: int) -> None:
  Machine._spare = None
  settings = hypothesis.settings(
      examples.settings(number),
      stateful_step_count=_NUM_OPERATIONS,
      # Sequences share a world, so they cannot be repeated to be shrunk.
      phases=[hypothesis.Phase.generate],
      suppress_health_check=list(hypothesis.HealthCheck),
  )
  stateful.run_state_machine_as_test(Machine, settings=settings)


def test_an_environment_stays_whole_in_any_order_of_operations():
  _COUNTS.clear()
  _run(20)
  assert not [name for name in _REACHED if not _COUNTS[name]]
