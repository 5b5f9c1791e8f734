"""Campaign C28: whatever order things happen in, an environment stays whole.

Run from the root of the repository, about eight minutes:

    python -m campaigns.machine_campaign

Hypothesis draws sequences of operations: a provider writes any float to
registers that saturate or refuse, blocks are pushed (now and then so hard that
the physics fails), registers are read, episodes are stepped, reset, abandoned
and rewound, worlds are saved, restored, closed and loaded anew. After each it
is checked that readings add up, that bodies are finite, that an episode begins
with FIRST and nothing else does, and that no error of the physics escapes.
Prints `C28 figure target verdict seed`. Arguments are the scale and the seed.
"""

import collections
import contextlib
import math
import sys
from typing import Any, Literal, final

from absl import logging
from dm_control.rl import control
import dm_env
import hypothesis
from hypothesis import stateful
from hypothesis import strategies as st
import numpy as np

from campaigns import figure_lines
from campaigns import readings_campaign
from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from realab_suite.feedback import providers
from tests import worlds
from tests.engine import helpers

NUM_SEQUENCES = 2_000
NUM_OPERATIONS = 50
TOLERANCE = 1e-9
_MAX_STEPS = 12

DICTATION: dict[str, Any] = {}
"""What the provider writes next, by register."""

COUNTS: collections.Counter[str] = collections.Counter()
"""How often something happened, over all sequences."""


@final
class Dictated(providers.Provider):
  """Writes what it is told to."""

  kind: Literal['dictated'] = 'dictated'

  def step(
      self,
      observation: Any,
      readings: Any,
      episode_start: np.ndarray,
      key: np.ndarray,
      state: Any,
  ) -> tuple[dict[str, np.ndarray], Any]:
    return {name: DICTATION.get(name, 0.0) for name in self.writes}, state


def _register(role: str, place: str, **more: Any) -> dict[str, Any]:
  return {
      'kind': 'two_block', 'role': role, 'place': place, 'range': [-2, 12],
      **more,
  }  # fmt: skip


_DESIGN = {
    'schema': 1,
    'name': 'machine',
    'registers': {
        'reward': _register('feedback', 'station_1'),
        'strict': _register('feedback', 'station_2', on_overflow='error'),
        'query': _register('query', 'station_3'),
        'place': {**_register('signal', 'station_4'), 'kind': 'block_position'},
    },
    'providers': [
        {
            'kind': 'dictated',
            'reads': ['query'],
            'writes': ['reward', 'strict', 'place'],
        }
    ],
}
_WRITTEN = ('reward', 'strict', 'place')
_ANY_FLOAT = st.one_of(
    st.floats(-3, 13),
    st.floats(-3, 13),
    st.floats(),
    st.sampled_from(
        [math.nan, math.inf, -math.inf, 0.0, -0.0, 1e300, -1e300, 5e-324, 12.0]
    ),
)
_SEEDS = st.integers(0, 2**20)


def load() -> Any:
  """Returns a new environment of the machine's."""
  with helpers.registered(providers.PROVIDERS, 'dictated', Dictated):
    return suite.load(
        'unlock_door', 'near', {'random': 5}, {'max_steps': _MAX_STEPS},
        design=_DESIGN,
    )  # fmt: skip


class Machine(stateful.RuleBasedStateMachine):
  """Operations on one environment, and what has to hold after each."""

  snapshots = stateful.Bundle('snapshots')
  # Compiling takes longer than a whole sequence, so sequences share a world.
  _spare: Any = None

  def __init__(self) -> None:
    super().__init__()
    COUNTS['sequences'] += 1
    self._env = Machine._spare or load()
    Machine._spare = None
    self._ledger = ledgers.Ledger()
    self._env.add_sink(self._ledger)
    self._env.rewind(0)
    self._checked: tuple[int, int] = (0, 0)
    # Whether the next step has to be a FIRST.
    self._is_pending = True

  def teardown(self) -> None:
    DICTATION.clear()
    self._env.remove_sink(self._ledger)
    Machine._spare = self._env

  def act(self, action: Any) -> dm_env.TimeStep | None:
    """Takes a step; returns `None` where a provider's writes were refused."""
    was_pending = self._is_pending
    refuses = not was_pending and any(
        not math.isfinite(DICTATION.get(name, 0.0)) for name in _WRITTEN
    )
    value = DICTATION.get('strict', 0.0)
    refuses |= not was_pending and not -2.0 <= value <= 12.0
    try:
      time_step = self._env.step(action)
    except errors.RegisterValueError as error:
      if not refuses or not str(error).isprintable():
        raise
      COUNTS['refused writes'] += 1
      self._is_pending = True
      return None
    # The physics may fail before anybody writes.
    has_failed = self._ledger.last.end is events.End.DIVERGENCE
    assert has_failed or not refuses
    assert time_step.first() == was_pending
    assert (time_step.reward, time_step.discount) in (
        [(None, None)] if was_pending else [(0.0, 1.0), (0.0, 0.0)]
    )
    for key, number in time_step.observation.items():
      assert np.isfinite(number).all(), key
    self._is_pending = time_step.last()
    COUNTS[f'steps, {time_step.step_type.name}'] += 1
    return time_step

  @stateful.rule(seed=_SEEDS)
  def step(self, seed: int) -> None:
    (action,) = helpers.random_actions(self._env, 1, seed)
    self.act(action)

  @stateful.rule(
      register=st.sampled_from(_WRITTEN), value=_ANY_FLOAT, seed=_SEEDS
  )
  def write(self, register: str, value: float, seed: int) -> None:
    DICTATION[register] = value
    (action,) = helpers.random_actions(self._env, 1, seed)
    time_step = self.act(action)
    COUNTS['writes'] += 1
    if time_step is not None and time_step.mid():
      (last,) = [
          entry
          for entry in self._ledger.last.entries[register][-4:]
          if isinstance(entry, registers.Write)
          and entry.step == self._ledger.last.num_steps
      ][-1:]
      assert last.requested == value
      assert last.applied == np.clip(value, -2.0, 12.0)
    # What was dictated once is not dictated for ever.
    DICTATION.clear()

  @stateful.rule(action=st.sampled_from(
      [None, 'x', math.nan, [math.nan] * 7, [1e9] * 7, [0.0] * 6, [True] * 7]
  ))  # fmt: skip
  def send_nonsense(self, action: Any) -> None:
    before = worlds.state_bytes(self._env.physics)
    try:
      self._env.step(action)
    except errors.ActionError:
      COUNTS['refused actions'] += 1
    else:
      raise AssertionError(f'{action!r} was accepted')
    assert worlds.state_bytes(self._env.physics) == before

  @stateful.rule(seed=_SEEDS, speed=st.floats(0, 8))
  def push(self, seed: int, speed: float) -> None:
    """Gives every block some velocity, as who throws things does."""
    velocities = self._env.physics.data.qvel
    noise = np.random.default_rng(seed).normal(size=velocities.shape)
    velocities += speed * noise
    COUNTS['pushes'] += 1
    self.step(seed)

  @stateful.rule(
      seed=_SEEDS, value=st.sampled_from([math.nan, math.inf, 1e11, 1e300])
  )
  def wreck(self, seed: int, value: float) -> None:
    """Puts something into the state that no physics can go on from."""
    if self._is_pending:
      return
    velocities = self._env.physics.data.qvel
    velocities[seed % len(velocities)] = value
    time_step = self.act(helpers.random_actions(self._env, 1, seed)[0])
    assert time_step is not None
    if np.isfinite(self._env.physics.data.qvel).all() and time_step.mid():
      # It was the block that the query moved: a write puts it to rest.
      COUNTS['mended'] += 1
      return
    assert time_step.last()
    assert time_step.discount == 1.0
    assert self._ledger.last.end is events.End.DIVERGENCE
    COUNTS['divergences'] += 1

  @stateful.rule()
  def read(self) -> None:
    before = worlds.state_bytes(self._env.physics)
    for read in worlds.shadow_reads(
        self._env.mechanism, self._env.physics, 'machine'
    ):
      register = self._env.mechanism.registers[read.register]
      applied = register.applied(self._env.physics)
      corruption = read.permanent + read.temporary
      assert abs(read.reading - applied - corruption) <= TOLERANCE
    assert worlds.state_bytes(self._env.physics) == before
    COUNTS['reads'] += 1

  @stateful.rule()
  def reset(self) -> None:
    is_open = self._has_open_episode()
    number = len(self._ledger.episodes)
    assert self._env.reset().first()
    if is_open:
      assert self._ledger.episodes[number - 1].end is events.End.ABANDONED
      COUNTS['abandoned'] += 1
    self._is_pending = False

  @stateful.rule(episode=st.integers(0, 3))
  def rewind(self, episode: int) -> None:
    is_open = self._has_open_episode()
    self._env.rewind(episode)
    if is_open:
      assert self._ledger.last.end is events.End.ABANDONED
      COUNTS['abandoned'] += 1
    self._is_pending = True
    COUNTS['rewinds'] += 1

  @stateful.rule(target=snapshots)
  def save(self) -> Any:
    COUNTS['snapshots'] += 1
    before = worlds.state_bytes(self._env.physics)
    snapshot = self._env.save()
    assert worlds.state_bytes(self._env.physics) == before
    return snapshot, self._is_pending

  @stateful.rule(saved=snapshots)
  def restore(self, saved: Any) -> None:
    snapshot, is_pending = saved
    self._env.restore(snapshot)
    assert self._env.save().to_bytes() == snapshot.to_bytes()
    self._is_pending = is_pending
    COUNTS['restored'] += 1

  @stateful.rule(draw=st.integers(0, 9))
  def close(self, draw: int) -> None:
    if draw:  # A new environment takes as long as a whole sequence.
      return
    old = self._env
    old.close()
    old.close()
    action = _no_op(old)
    for use in (
        old.reset, old.action_spec, old.observation_spec, old.save,
        lambda: old.step(action), lambda: old.rewind(0),
    ):  # fmt: skip
      with contextlib.suppress(errors.ClosedError):
        use()
        raise AssertionError('a closed environment was used')
    self._env = load()
    self._ledger = ledgers.Ledger()
    self._env.add_sink(self._ledger)
    self._checked = (0, 0)
    self._is_pending = True
    COUNTS['closed'] += 1

  @stateful.invariant()
  def bodies_are_finite(self) -> None:
    data = self._env.physics.data
    for name in ('qpos', 'qvel', 'xpos', 'userdata'):
      assert np.isfinite(getattr(data, name)).all(), name
    assert np.abs(data.qpos).max() < 1e3

  @stateful.invariant()
  def readings_add_up(self) -> None:
    """Looks at the episodes that are new, or have grown."""
    episodes = self._ledger.episodes
    for write, read in readings_campaign.pairs(episodes[self._checked[0] :]):
      saturation = write.applied - write.requested
      error = read.reading - write.requested - (
          saturation + read.permanent + read.temporary
      )  # fmt: skip
      # A request of 1e300 is saturated by as much, to the last bit of that.
      assert abs(error) <= TOLERANCE * max(1.0, abs(write.requested))
      COUNTS['readings'] += 1
    self._checked = (max(0, len(episodes) - 1), 0)

  @stateful.invariant()
  def all_episodes_but_the_last_have_ended(self) -> None:
    episodes = self._ledger.episodes
    assert all(episode.end is not None for episode in episodes[:-1])
    if episodes and not self._is_pending:
      assert episodes[-1].end is None

  def _has_open_episode(self) -> bool:
    episodes = self._ledger.episodes
    return bool(episodes) and episodes[-1].end is None


def _no_op(env: Any) -> np.ndarray:
  """Returns an action for an environment that may be closed."""
  return np.zeros(len(env.codec.spec.minimum))


def settings(num_sequences: int, num_operations: int) -> hypothesis.settings:
  """Returns how many sequences are to be drawn, and how long they are."""
  return hypothesis.settings(
      max_examples=num_sequences,
      stateful_step_count=num_operations,
      database=None,
      deadline=None,
      derandomize=False,
      phases=[hypothesis.Phase.generate],
      suppress_health_check=list(hypothesis.HealthCheck),
      report_multiple_bugs=False,
  )


def run(
    num_sequences: int,
    seed: int,
    machine: type[Machine] = Machine,
    num_operations: int = NUM_OPERATIONS,
) -> str:
  """Runs sequences; returns what was falsified first, '' if nothing was."""
  Machine._spare = None
  seeded = hypothesis.seed(seed)(machine)
  try:
    stateful.run_state_machine_as_test(
        seeded, settings=settings(num_sequences, num_operations)
    )
  except control.PhysicsError as error:
    return f'an error of the physics escaped: {error}'
  except Exception as error:
    notes = getattr(error, '__notes__', [])
    return '\n'.join([f'{type(error).__name__}: {error}', *notes])
  return ''


REACHED = (
    'steps, FIRST', 'steps, MID', 'steps, LAST', 'writes', 'refused writes',
    'refused actions', 'pushes', 'divergences', 'reads', 'abandoned', 'rewinds',
    'snapshots', 'restored', 'readings',
)  # fmt: skip


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C28', seed)
  logging.set_verbosity(logging.ERROR)  # Of physics that fail on purpose.
  number = max(50, round(scale * NUM_SEQUENCES))
  COUNTS.clear()
  falsified = run(number, seed)
  lines.at_most('falsifying examples', bool(falsified), 0)
  lines.at_least('sequences', COUNTS['sequences'], number)
  for name in (*REACHED, 'closed'):
    lines.at_least(name, COUNTS[name], 1)
  if falsified:
    print(falsified, file=sys.stderr)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
