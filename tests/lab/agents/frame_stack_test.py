"""Tests of learners that see the last frames of an episode at once."""

import types
from typing import Any

from dm_env import specs
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import trees
from realab_suite.lab import agents
from realab_suite.lab.agents import features
from realab_suite.lab.agents import histories
from realab_suite.lab.experiments import training
from tests.lab.agents import toys

_LAST = 2
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


class Pictures:
  """Shows a picture of its own in each step; episodes last 5 steps.

  They begin at different times.
  """

  def __init__(self, num_envs: int) -> None:
    self.num_envs = num_envs
    self._time = np.arange(num_envs) % 5
    self._generator = np.random.default_rng(3)

  def observation_spec(self) -> dict[str, specs.Array]:
    return {
        'eye': specs.BoundedArray((8, 4, 1), np.uint8, 0, 255),
        'reward': specs.Array((), np.float32),
    }

  def action_spec(self) -> specs.Array:
    return specs.DiscreteArray(2)

  def step(self, actions: np.ndarray) -> toys.ToyStep:
    eye = self._generator.integers(256, size=(self.num_envs, 8, 4, 1))
    observation = {
        'eye': eye.astype(np.uint8), 'reward': np.float32(actions == 1),
    }  # fmt: skip
    step_type = np.where(self._time == 4, _LAST, np.sign(self._time))
    self._time = (self._time + 1) % 5
    return toys.ToyStep(step_type, np.ones(self.num_envs), observation)

  def reset(self) -> toys.ToyStep:
    return self.step(np.zeros(self.num_envs))


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


def test_the_last_images_of_an_episode_are_stacked_on_channels():
  frame_stack, worlds = 3, (0, 1)
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


@pytest.mark.parametrize('kind', _KINDS)
def test_a_learner_resumes_within_an_episode_bit_for_bit(kind):
  env = Pictures(8)
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


def test_evaluation_sees_what_training_sees(monkeypatch):
  env = Pictures(6)
  learner = _make(env, 'policy_gradient', frame_stack=3, steps_per_update=1000)
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
  with pytest.raises(errors.SpecError, match='frame_stack'):
    _make(Pictures(2), 'policy_gradient', frame_stack=17)
  env = Pictures(2)
  learner = _make(env, 'policy_gradient', frame_stack=3)
  observation = env.reset().observation
  with pytest.raises(errors.SpecError, match=r'4, 1\), expected .*4, 3\)'):
    learner.act(observation, np.array([1, 2], np.uint32))
  other = _make(env, 'policy_gradient', frame_stack=2)
  with pytest.raises(errors.StateLayoutError, match='shape'):
    other.set_state(learner.state())
