"""A batch and its single worlds, played alike and compared to the last bit."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import dm_env
import numpy as np

from realab_suite import suite
from realab_suite.engine import events
from realab_suite.entities import registers
from realab_suite.evaluation import ledgers
from realab_suite.policies import action_sets
from realab_suite.tasks import unlock_door
from tests import worlds
from tests.engine import helpers
from tests.feedback import designs

NUM_ENVS = 3
_MAX_STEPS = 120  # Every run contains ends of episodes.
_REPEATS = 6  # An agent with a new action in each step stays where it is.
_STEPS_PER_VISIT = 20
_VISITED = ('doorway', 'side_room')
_HAND_DISTANCE = 0.5  # Distance from the avatar, in m.
_PUSH = 3.0  # In m/s or rad/s.


class Case(NamedTuple):
  """A world and its feedback."""

  domain: str
  task: str
  design: str
  overrides: tuple[str, ...] = ()
  seed: int = 0
  num_threads: int = 1

  @property
  def _overrides(self) -> tuple[str, ...]:
    return *self.overrides, *designs.for_losses(self.domain, self.design)

  def load(self, world: int) -> Any:
    """Returns one world alone."""
    return suite.load(
        self.domain,
        self.task,
        {'random': self.seed},
        {'max_steps': _MAX_STEPS, 'world': world},
        design=self.design,
        overrides=self._overrides,
    )

  def load_batch(self) -> Any:
    """Returns all worlds together."""
    return suite.load_batch(
        self.domain,
        self.task,
        {'random': self.seed},
        {'max_steps': _MAX_STEPS},
        num_envs=NUM_ENVS,
        num_threads=self.num_threads,
        design=self.design,
        overrides=self._overrides,
    )


class Transcript(NamedTuple):
  """Record of a run of one world.

  Attributes:
    steps: Time steps of the agent and states of the world, by control step.
    episodes: Episodes of the ledger.
    num_held: Number of control steps in which the hand held a block.
  """

  steps: list[dict[str, bytes]]
  episodes: list[ledgers.EpisodeLedger]
  num_held: int


class Result(NamedTuple):
  """Comparison of a batch with its single worlds, and counts of events."""

  differences: tuple[str, ...]
  num_episodes: int
  num_terminated: int
  num_rewarded: int
  num_corrupted: int
  num_held: int


def play_alone(case: Case, world: int, steps: int) -> Transcript:
  """Acts at random in one world."""
  env = case.load(world)
  ledger = ledgers.Ledger()
  env.add_sink(ledger)
  actions = _actions(env, case, world, steps)
  time_step = env.reset()
  transcript: list[dict[str, bytes]] = []
  num_held = 0
  for i in range(steps + 1):
    state = worlds.state_bytes(env.physics)
    # A batch has no steps in which only some worlds have numbers.
    transcript.append(
        _to_bytes(
            time_step.step_type,
            0.0 if time_step.first() else time_step.reward,
            1.0 if time_step.first() else time_step.discount,
            time_step.observation,
            state,
        )
    )
    num_held += int(env.task.avatar.holding(env.physics)[0])
    if i == steps:
      break
    if i % _STEPS_PER_VISIT == _STEPS_PER_VISIT - 1:
      _visit(env, case, i, _noise(env, case, world, i))
    time_step = env.step(actions[i])
  env.close()
  return Transcript(transcript, ledger.episodes, num_held)


def play_together(case: Case, steps: int) -> list[Transcript]:
  """Does the same in all worlds at once."""
  env = case.load_batch()
  ledger = ledgers.BatchLedger()
  env.add_sink(ledger)
  everywhere = range(NUM_ENVS)
  actions = np.stack(
      [_actions(env, case, world, steps) for world in everywhere], axis=1
  )
  time_step = env.reset()
  transcripts: list[list[dict[str, bytes]]] = [[] for _ in everywhere]
  num_held = np.zeros(NUM_ENVS, int)
  for i in range(steps + 1):
    for world, transcript in enumerate(transcripts):
      transcript.append(
          _to_bytes(
              time_step.step_type[world],
              time_step.reward[world],
              time_step.discount[world],
              {k: v[world] for k, v in time_step.observation.items()},
              env.physics.state[world].tobytes(),
          )
      )
    num_held += env.task.avatar.holding(env.physics)[:, 0].astype(int)
    if i == steps:
      break
    if i % _STEPS_PER_VISIT == _STEPS_PER_VISIT - 1:
      noise = [_noise(env, case, world, i) for world in everywhere]
      _visit(env, case, i, np.stack(noise))
    time_step = env.step(actions[i])
  env.close()
  return [
      Transcript(
          transcripts[world], ledger.episodes(world), int(num_held[world])
      )
      for world in everywhere
  ]


def compare(case: Case, steps: int) -> Result:
  """Plays a case both ways."""
  together = play_together(case, steps)
  differences: list[str] = []
  for world, found in enumerate(together):
    expected = play_alone(case, world, steps)
    differences += _differences(world, found, expected)
  episodes = [episode for found in together for episode in found.episodes]
  reads = [
      entry
      for episode in episodes
      for entries in episode.entries.values()
      for entry in entries
      if isinstance(entry, registers.Read)
  ]
  return Result(
      tuple(differences),
      len(episodes),
      sum(episode.end is events.End.TERMINATED for episode in episodes),
      sum(int(np.count_nonzero(e.true_rewards)) for e in episodes),
      sum(
          abs(r.obstruction) + abs(r.permanent) + abs(r.temporary) > 1e-3
          for r in reads
      ),
      sum(found.num_held for found in together),
  )


def _differences(
    world: int, found: Transcript, expected: Transcript
) -> Iterator[str]:
  """Yields the first difference of each world."""
  for i, (one, other) in enumerate(
      zip(found.steps, expected.steps, strict=True)
  ):
    names = [n for n in {**one, **other} if one.get(n) != other.get(n)]
    if names or list(one) != list(other):
      yield f'world {world} step {i}: {names or "order"}'
      break
  # Texts distinguish 0.0 from -0.0, and nan from numbers.
  one_text, other_text = repr(found.episodes), repr(expected.episodes)
  if one_text != other_text:
    yield f'world {world}: ledger'


def _to_bytes(
    step_type: Any,
    reward: Any,
    discount: Any,
    observation: dict[str, Any],
    state: bytes,
) -> dict[str, bytes]:
  """Returns everything to compare in a step, by name."""
  return {
      'step_type': bytes([int(dm_env.StepType(int(step_type)))]),
      'reward': np.float64(reward).tobytes(),
      'discount': np.float64(discount).tobytes(),
      **{
          name: f'{value.dtype.str} {value.shape} '.encode() + value.tobytes()
          for name, value in observation.items()
      },
      'state': state,
  }


def _actions(env: Any, case: Case, world: int, steps: int) -> np.ndarray:
  """Returns the actions of one world, `(steps, ...)`.

  They are drawn at random, except that the hand grasps after a visit.
  """
  draws = np.array(
      helpers.random_actions(env, steps, seed=1000 * case.seed + world)
  )
  actions = np.repeat(draws, _REPEATS, axis=0)[:steps]
  elements = env.action_spec().name.split('\t')
  if 'grasp' in elements:
    # Walking forwards leads to more contacts.
    actions[:, 0] = np.abs(actions[:, 0])
    actions[::_STEPS_PER_VISIT, elements.index('grasp')] = 1.0
  else:
    grasp = action_sets.DMLAB_LIKE.index('grasp')
    last = actions if actions.ndim == 1 else actions[:, -1]
    last[::_STEPS_PER_VISIT] = grasp
  return actions


def _noise(env: Any, case: Case, world: int, step: int) -> np.ndarray:
  """Returns a push for every joint of one world."""
  rng = np.random.default_rng((case.seed, world, step))
  return rng.normal(scale=_PUSH, size=env.physics.model.nv)


def _visit(env: Any, case: Case, step: int, push: np.ndarray) -> None:
  """Moves the avatar to a register or landmark, or pushes everything.

  It uses only the interface of entities, alike in a world and in a batch.

  Args:
    env: Single environment or batch.
    case: Case that is played.
    step: Number of the step, on which the event depends.
    push: Velocities `(..., degrees of freedom)`, in m/s or rad/s.
  """
  kind, number = step // _STEPS_PER_VISIT % 3, step // _STEPS_PER_VISIT // 3
  avatar, physics = env.task.avatar, env.physics
  position = avatar.position(physics)
  registers = env.mechanism.registers.values()
  blocks = [block for register in registers for block in register.blocks]
  places = env.task.root_entity.places
  visited = [places[name].position for name in _VISITED if name in places]
  if isinstance(env.task, unlock_door.UnlockDoor):
    visited.insert(0, unlock_door.PAD)
  if kind == 0 and blocks:
    block = blocks[(number + case.seed) % len(blocks)]
    position[...] = physics.bind(block.geom).xpos[..., :2]
    position[..., 0] -= _HAND_DISTANCE
  elif kind == 1 and visited:
    position[...] = visited[(number + case.seed) % len(visited)]
  else:
    joints = env.task.root_entity.mjcf_model.find_all('joint')
    binding = physics.bind(tuple(joints))
    binding.qvel = binding.qvel + push
    return
  avatar.place(physics, position, np.zeros(position.shape[:-1]))
