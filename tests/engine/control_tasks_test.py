"""Tasks of `dm_control.suite` with registers beside them."""

from typing import Any

from dm_control import composer
from dm_control import suite as control_suite
from dm_control.rl import control
import numpy as np
import pytest

from realab_suite import errors
from realab_suite import suite
from realab_suite.engine import seeding
from realab_suite.evaluation import ledgers
from tests import examples
from tests.engine import embedded
from tests.engine import helpers

_SEED = 11
_TOTAL_MASS = (
    "compiler attribute 'settotalmass' is deprecated and will be removed in a"
    ' future release: scale the masses and densities in the model, or call'
    ' mj_setTotalmass and mj_setConst on the compiled model'
)
# Each of them has what the ones before lack: contacts that are disabled;
# contacts; a fluid without gravity and constraints; equalities, and walls that
# are planes; a model that an episode changes; a terrain and activations. The
# profile `long` plays all.
_NAMES = [
    ('cartpole', 'two_poles'),
    ('cheetah', 'run'),
    ('fish', 'swim'),
    ('manipulator', 'bring_ball'),
    ('point_mass', 'hard'),
    ('quadruped', 'fetch'),
]
if examples.IS_LONG:
  _NAMES = [
      (domain, task)
      for domain, tasks in embedded.CONTROL_TASKS.items()
      for task in tasks
  ]


def _stock(domain: str, task: str) -> tuple[control.Environment, Any]:
  generator = np.random.RandomState(0)
  return (
      control_suite.load(domain, task, task_kwargs={'random': generator}),
      generator,
  )


def _bytes(observation: Any) -> dict[str, tuple[str, tuple[int, ...], bytes]]:
  return {
      key.removeprefix('senses/'): (
          np.asarray(value).dtype.str,
          np.shape(value),
          np.asarray(value).tobytes(),
      )
      for key, value in observation.items()
      if not key.startswith('registers/') and key != 'senses/time_left'
  }


@pytest.mark.mujoco_warns(_TOTAL_MASS)
@pytest.mark.parametrize(('domain', 'task'), _NAMES)
def test_a_task_beside_registers_equals_the_original_bit_for_bit(
    domain: str, task: str
):
  stock, generator = _stock(domain, task)
  env = suite.load(
      f'dm_control/{domain}',
      task,
      {'random': _SEED},
      design=embedded.control_design(domain),
  )
  ledger, sink = ledgers.Ledger(), helpers.RecordingSink()
  env.add_sink(ledger)
  env.add_sink(sink)
  random = np.random.default_rng(0)
  low = np.maximum(stock.action_spec().minimum, -1)
  high = np.minimum(stock.action_spec().maximum, 1)
  for episode in range(2):
    seeding.reseed(generator, _SEED, 0, episode, 'reset/0')
    expected, found = stock.reset(), env.reset()
    for _ in range(6):
      assert _bytes(found.observation) == _bytes(expected.observation)
      action = random.uniform(low, high)
      expected, found = stock.step(action), env.step(action)
      assert ledger.last.true_rewards[-1] == expected.reward
      assert (found.reward, found.discount) == (0.0, expected.discount)
      assert found.step_type == expected.step_type
      # Nothing has touched a register: what was written is what is read.
      for name, register in env.mechanism.registers.items():
        np.testing.assert_allclose(
            register.read(env.physics),
            register.applied(env.physics),
            atol=1e-6,
            err_msg=name,
        )
  measured = sink.requested('score')
  np.testing.assert_allclose(
      measured[-1], np.sum(ledger.last.true_rewards[:-1]), atol=1e-12
  )
  env.close()


def test_the_table_of_the_documentation_lists_the_tested_tasks():
  rows = helpers.rows_of_page('embedding.md', 'equal, bit for bit', 3)
  found = {
      row[0]: row[1].split(', ')
      for row in rows
      if row[0] in embedded.CONTROL_TASKS
  }
  assert found == embedded.CONTROL_TASKS


@pytest.mark.parametrize('channel', ['embedded', 'secure'])
def test_a_body_that_touches_a_register_is_stopped_by_it(channel: str):
  """A pendulum, which has no contacts of its own, swings against a block."""
  design = {
      'schema': 1,
      'name': 'd',
      'channel': channel,
      'registers': {
          'r': {
              'kind': 'block_position', 'role': 'feedback', 'range': [-5, 5],
              'place': [0, 0], 'block_size': 0.3,
          },
      },
      'providers': [{'kind': 'constant', 'writes': ['r'], 'value': 0.0}],
  }  # fmt: skip
  stock, generator = _stock('pendulum', 'swingup')
  env = suite.load(
      'dm_control/pendulum', 'swingup', {'random': 3}, design=design
  )
  env.reset()
  seeding.reseed(generator, 3, 0, 0, 'reset/0')
  stock.reset()
  readings, num_equal = [], 0
  for _ in range(120):
    expected, found = stock.step([0.0]), env.step([0.0])
    readings.append(found.observation['registers/r'])
    num_equal += _bytes(found.observation) == _bytes(expected.observation)
    state, own = env.physics.data.qpos, env.task.own_physics.data.qpos
    np.testing.assert_array_equal(state[: len(own)], own)
  assert 0 < num_equal < 120
  assert (np.ptp(readings) > 1e-3) == (channel == 'embedded')
  env.close()


def test_a_loaded_task_gives_the_same_as_its_name():
  by_name = suite.load(
      'dm_control/reacher',
      'easy',
      {'random': 5},
      design=embedded.control_design('reacher'),
  )
  loaded = control_suite.load('reacher', 'easy', task_kwargs={'random': 99})
  loaded.reset()  # It may have been used before.
  loaded.step([0.3, -0.2])
  env = suite.embed(loaded, embedded.control_design('reacher'), random=5)
  assert env.max_steps == by_name.max_steps == 1000
  for action in [np.zeros(2), *helpers.random_actions(by_name, 5)]:
    expected = helpers.to_bytes(by_name.step(action))
    assert helpers.to_bytes(env.step(action)) == expected


def test_elements_of_an_action_have_the_names_of_actuators():
  env = suite.load('dm_control/reacher', 'easy')
  assert env.action_spec().name == 'shoulder\twrist'


def test_a_meter_measures_bodies_of_the_task():
  design = embedded.control_design('reacher')
  meter = {'measures': {'kind': 'distance', 'from': 'finger', 'to': 'arm'}}
  design['meters'] = [meter | {'writes': 'score'}]
  env = suite.load('dm_control/reacher', 'easy', {'random': 5}, design=design)
  sink = helpers.RecordingSink()
  env.add_sink(sink)
  env.reset()
  env.step(np.zeros(2))
  assert 0.0 < sink.requested('score')[0] < 0.3


def test_registers_stand_on_the_height_0_where_the_floor_is_below():
  env = suite.load(
      'dm_control/cartpole',
      'two_poles',
      {'random': 1},
      design=embedded.control_design('x'),
  )
  env.reset()
  block = env.mechanism.registers['reward'].blocks[0]
  for _ in range(20):
    env.step(np.zeros(1))
  height = env.physics.bind(block.geom).xpos[2]
  np.testing.assert_allclose(height, block.half_size, atol=1e-3)


def _swimmer_of_three() -> control.Environment:
  return control_suite.swimmer.swimmer(n_links=3)


def _shown() -> control.Environment:
  return control_suite.load('reacher', 'easy', visualize_reward=True)


@pytest.mark.parametrize(
    ('make', 'reason'),
    [
        (_swimmer_of_three, 'source is unknown'),
        (_shown, 'visualize_reward=True would show'),
    ],
)
def test_a_task_that_cannot_be_embedded_is_refused(make: Any, reason: str):
  with pytest.raises(errors.SpecError, match=reason):
    suite.embed(make(), 'none')


def test_unknown_tasks_are_refused_with_the_known_ones():
  with pytest.raises(
      errors.UnknownNameError, match=r'known are .*reacher\.easy'
  ):
    suite.load('dm_control/reacher', 'impossible')


def test_a_batch_is_refused_with_the_remedy():
  with pytest.raises(errors.SpecError, match="'world': i"):
    suite.load_batch('dm_control/reacher', 'easy', num_envs=2)


def test_a_start_inside_a_register_is_drawn_again_and_at_last_refused():
  design = embedded.control_design('point_mass')
  # All over the places where the mass begins.
  design['registers']['reward'] |= {
      'place': [0, 0, 0], 'block_size': 1.0, 'initial': 0,
  }  # fmt: skip
  del design['registers']['score']
  design |= {'meters': [], 'providers': []}
  env = suite.load(
      'dm_control/point_mass', 'easy', {'random': 1}, design=design
  )
  with pytest.raises(composer.EpisodeInitializationError, match="'reward'"):
    env.reset()
