"""Tests of learners that see the last frames of an episode at once."""

import dataclasses
import types
from typing import Any

from dm_env import specs
import numpy as np
import pytest

pytest.importorskip('jax', reason='JAX is in the extra `agents`')
pytest.importorskip('optax', reason='optax is in the extra `agents`')
pytest.importorskip('equinox', reason='equinox is in the extra `agents`')

from realab_suite import errors
from realab_suite import trees
from realab_suite.lab import agents
from realab_suite.lab.agents import features
from realab_suite.lab.agents import histories
from realab_suite.lab.experiments import training
from tests.lab.agents import toys

_FIRST, _MID, _LAST = 0, 1, 2
_QUICK = {
    'hidden': [16],
    'learning_rate': 0.01,
    'steps_per_update': 8,
    'minibatch': 64,
    'reward': 'reward',
    'gamma': 0,
}
_KINDS = {
    'policy_gradient': {},
    'q_learning': {'min_replay': 64, 'minibatch': 32, 'replay_size': 1024},
}


@dataclasses.dataclass
class Motion:
  """A bright row moves up or down; the best action names the direction.

  A single frame does not show the direction, and the number beside it is noise.
  Episodes last 5 steps, begin at different times, and have another direction
  each.
  """

  num_envs: int
  channels: int = 1

  def __post_init__(self) -> None:
    self._generator = np.random.default_rng(3)
    self._time = np.arange(self.num_envs) % 5 - 1
    self._draw(np.ones(self.num_envs, bool))
    self.scores: list[float] = []

  def observation_spec(self) -> dict[str, specs.Array]:
    return {
        'noise': specs.BoundedArray((2,), np.float32, 0.0, 1.0),
        'eye': specs.BoundedArray((8, 4, self.channels), np.uint8, 0, 255),
        'reward': specs.Array((), np.float32),
    }

  def action_spec(self) -> specs.Array:
    return specs.DiscreteArray(2)

  def reset(self) -> toys.ToyStep:
    return self._show(np.zeros(self.num_envs), np.full(self.num_envs, _FIRST))

  def step(self, actions: np.ndarray) -> toys.ToyStep:
    self._time += 1
    is_first = self._time == 5
    self._draw(is_first)
    self._time[is_first] = 0
    good = actions == self._direction
    # Nothing can be known about the direction in the first step.
    self.scores += list(good[~is_first & (self._time > 1)].astype(float))
    self._row = (self._row + 2 * self._direction - 1) % 8
    step_type = np.where(self._time == 4, _LAST, _MID)
    return self._show(good, np.where(is_first, _FIRST, step_type))

  def _draw(self, worlds: np.ndarray) -> None:
    direction = self._generator.integers(2, size=self.num_envs)
    row = self._generator.integers(8, size=self.num_envs)
    if not hasattr(self, '_row'):
      self._direction, self._row = direction, row
    self._direction = np.where(worlds, direction, self._direction)
    self._row = np.where(worlds, row, self._row)

  def _show(self, reward: np.ndarray, step_type: np.ndarray) -> toys.ToyStep:
    n = self.num_envs
    eye = np.zeros((n, 8, 4, self.channels), np.uint8)
    eye[np.arange(n), self._row] = 255
    noise = self._generator.uniform(size=(n, 2)).astype(np.float32)
    observation = {'noise': noise, 'eye': eye, 'reward': np.float32(reward)}
    return toys.ToyStep(step_type, np.ones(n), observation)


def _make(env: Any, kind: str, seed: int = 1, **options: Any) -> agents.Learner:
  return agents.make(
      {'kind': kind, **_QUICK, **_KINDS[kind], **options},
      env.observation_spec(),
      env.action_spec(),
      env.num_envs,
      seed,
  )


def _stacking(spec: Any, number: int) -> tuple[Any, histories.FrameStack]:
  """Returns the encoder of stacks of images, and the wrapper that stacks."""
  encoder = features.Encoder.from_spec(spec, number)
  setting = types.SimpleNamespace(encoder=encoder)
  learner: Any = types.SimpleNamespace(setting=setting)
  return encoder, histories.FrameStack(number, learner)


def _image(*values: int, channels: int) -> np.ndarray:
  """Returns an image of one value for each world, `(worlds, 2, 3, channels)`.

  Channel c of value v is `v + 100 * c`.
  """
  tones = np.add.outer(np.array(values), 100 * np.arange(channels))
  shape = (len(values), 2, 3, channels)
  return np.broadcast_to(tones[:, None, None], shape).astype(np.uint8)


# What two worlds show, the steps in which their episodes begin, and what is
# seen of three frames.
_SHOWN = ((1, 11), (2, 12), (3, 13), (4, 14), (5, 15))
_BEGINS = ((1, 1), (0, 0), (0, 1), (0, 0), (1, 0))
_SEEN = (
    ((1, 1, 1), (11, 11, 11)),
    ((1, 1, 2), (11, 11, 12)),
    ((1, 2, 3), (13, 13, 13)),
    ((2, 3, 4), (13, 13, 14)),
    ((5, 5, 5), (13, 14, 15)),
)


@pytest.mark.parametrize('frame_stack', [1, 2, 3])
@pytest.mark.parametrize('worlds', [(0, 1), (1,)])
def test_the_last_images_of_an_episode_are_stacked_on_channels(
    frame_stack, worlds
):
  spec = {
      'b': specs.BoundedArray((2, 3, 2), np.uint8, 0, 255),
      # Not images: a vector of bytes, and an array of numbers of three axes.
      'bytes': specs.BoundedArray((2,), np.uint8, 0, 255),
      'map': specs.Array((2, 3, 1), np.float32),
      'a': specs.BoundedArray((2, 3, 1), np.uint8, 0, 255),
  }
  encoder, wrapper = _stacking(spec, frame_stack)
  shapes = {'b': (2, 3, 2 * frame_stack), 'a': (2, 3, frame_stack)}
  assert encoder.image_shapes == shapes
  assert encoder.vector_size == 2 + 6
  earlier = None
  for shown, begins, seen in zip(_SHOWN, _BEGINS, _SEEN, strict=True):
    here = [shown[w] for w in worlds]
    observation = {
        'a': _image(*here, channels=1),
        'b': _image(*here, channels=2),
        'bytes': np.zeros((len(here), 2), np.uint8),
        'map': np.ones((len(here), 2, 3, 1), np.float32),
    }
    is_first = np.array([begins[w] for w in worlds], bool)
    earlier = wrapper.see(observation, is_first, earlier)
    packed = encoder.pack(earlier, len(here))
    for name, channels in (('a', 1), ('b', 2)):
      values = np.array([seen[w][3 - frame_stack :] for w in worlds])
      tones = values[:, :, None] + 100 * np.arange(channels)
      tones = tones.reshape(len(here), -1)
      for row in range(2):
        np.testing.assert_array_equal(packed[name][:, row, row], tones)
      assert packed[name].dtype == np.uint8
    for name in ('bytes', 'map'):
      assert earlier[name] is observation[name]


def test_without_an_earlier_step_an_episode_may_be_under_way():
  spec = {'a': specs.BoundedArray((2, 3, 1), np.uint8, 0, 255)}
  _, wrapper = _stacking(spec, 2)
  observation = {'a': _image(7, 8, channels=1)}
  stacked = wrapper.see(observation, np.zeros(2, bool), None)['a']
  np.testing.assert_array_equal(stacked[:, 1, 2], [[7, 7], [8, 8]])
  # The next step changes nothing in what was returned.
  wrapper.see(
      {'a': _image(9, 9, channels=1)}, np.zeros(2, bool), {'a': stacked}
  )
  np.testing.assert_array_equal(stacked[:, 1, 2], [[7, 7], [8, 8]])


@pytest.mark.parametrize('frame_stack', [1, 2])
def test_only_a_stack_shows_a_motion(frame_stack):
  env = Motion(64, channels=3)
  learner = _make(env, 'policy_gradient', frame_stack=frame_stack, epochs=4)
  time_step = env.reset()
  for _ in range(400):
    time_step = env.step(learner.step(time_step))
  last = np.mean(env.scores[-2000:])
  assert last > 0.9 if frame_stack == 2 else 0.4 < last < 0.6


@pytest.mark.parametrize('kind', _KINDS)
def test_a_learner_resumes_within_an_episode_bit_for_bit(kind):
  env = Motion(8)
  learner = _make(env, kind, frame_stack=3)
  time_step = env.reset()
  for _ in range(12):
    time_step = env.step(learner.step(time_step))
  successor = _make(env, kind, seed=7, frame_stack=3)
  successor.set_state(learner.state())
  for _ in range(9):
    actions = learner.step(time_step)
    np.testing.assert_array_equal(actions, successor.step(time_step))
    time_step = env.step(actions)
  assert trees.are_equal(learner.state(), successor.state())


@pytest.mark.parametrize('kind', _KINDS)
def test_evaluation_sees_what_training_sees(kind, monkeypatch):
  env = Motion(6)
  learner = _make(env, kind, frame_stack=3, steps_per_update=1000)
  actor = training.LearnerActor(learner, 0, greedy=False)
  seen = []
  choose = learner._choose

  def watched(observation, keys, greedy):
    seen.append(observation)
    return choose(observation, keys, greedy)

  monkeypatch.setattr(learner, '_choose', watched)
  time_step = env.reset()
  for _ in range(11):
    actor.act(time_step)
    time_step = env.step(learner.step(time_step))
    acted, trained = seen[-2:]
    assert trees.are_equal(acted, trained)
  # Frames differ within a stack, so the check above is not empty.
  assert (acted['eye'][..., 0] != acted['eye'][..., 2]).any()


def test_what_cannot_be_stacked_is_refused_in_one_line():
  with pytest.raises(errors.SpecError, match=r'frame_stack: 2; .*is an image'):
    agents.make(
        {'kind': 'policy_gradient', 'reward': 'reward', 'frame_stack': 2},
        toys.Aim(2).observation_spec(),
        toys.Aim(2).action_spec(),
        2,
        0,
    )
  for given in (0, 1.5, 17, 10**9):
    with pytest.raises(errors.SpecError, match='frame_stack'):
      _make(Motion(2), 'policy_gradient', frame_stack=given)
  env = Motion(2)
  learner = _make(env, 'policy_gradient', frame_stack=3)
  observation = env.reset().observation
  for method in (
      learner.probabilities,
      lambda one: learner.act(one, np.array([1, 2], np.uint32)),
  ):
    with pytest.raises(errors.SpecError, match=r'4, 1\), expected .*4, 3\)'):
      method(observation)
  other = _make(env, 'policy_gradient', frame_stack=2)
  with pytest.raises(errors.StateLayoutError, match='shape'):
    other.set_state(learner.state())
