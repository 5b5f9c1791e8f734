"""A register of three blocks and two ports, in the rest of the package.

Its ports are scalar everywhere outside the register, and one write sets both.
"""

import copy
from typing import Literal

import numpy as np
import pytest

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite.entities import registers
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import ledgers
from realab_suite.feedback import providers
from realab_suite.feedback import register_kinds
from realab_suite.feedback import specs
from realab_suite.lab.attribution import attribution
from realab_suite.lab.audit import aiming
from realab_suite.lab.audit import attacks
from realab_suite.tasks import collect_apples


@providers.PROVIDERS.add('copies_of_two')
class Copies(providers.Provider):
  """Writes what it reads, unless the first reading is above `silent_above`."""

  kind: Literal['copies_of_two'] = 'copies_of_two'
  silent_above: float = 1000.0
  omits: int = 0

  def initial_state(self, batch_shape):
    return np.zeros(batch_shape)

  def step(self, observation, readings, episode_start, key, state):
    speaks = np.array(readings[self.reads[0]] <= self.silent_above)
    pairs = [*zip(self.writes, self.reads, strict=True)]
    return {
        port: (readings[other], speaks) for port, other in pairs[self.omits :]
    }, state


_ABACUS = {'kind': 'abacus_2', 'range': [-5, 5], 'scale': 0.1}
_SEEN = {**_ABACUS, 'range': [-5, 18]}
_DESIGN = {
    'schema': 1,
    'name': 'counted',
    'registers': {
        'seen': {**_SEEN, 'role': 'meter', 'place': 'station_2'},
        'told': {**_ABACUS, 'role': 'feedback', 'place': 'station_1'},
    },
    'meters': [
        {'measures': 'score', 'writes': 'seen_a'},
        {
            'measures': {'kind': 'position', 'of': 'avatar', 'axis': 'x'},
            'writes': 'seen_b',
        },
    ],
    'providers': [
        {
            'kind': 'copies_of_two',
            'reads': ['seen_a', 'seen_b'],
            'writes': ['told_a', 'told_b'],
        }
    ],
    'learner': {'kind': 'policy_gradient', 'reward': 'told_a'},
}
_PORTS = ['seen_a', 'seen_b', 'told_a', 'told_b']
_TOLD = _PORTS[2:]
_MAX_STEPS = 12


def _design(**registers_or_fields):
  """Returns the design with other fields of `told`, or of the design."""
  design = copy.deepcopy(_DESIGN)
  for key, value in registers_or_fields.items():
    part = design if key in ('providers', 'learner') else design['registers']
    part[key] = value
  return design


def _load(design=_DESIGN, world=0, max_steps=_MAX_STEPS, **options):
  return suite.load(
      'unlock_door', 'near', {'random': 1},
      {'max_steps': max_steps, 'world': world}, design=design, **options,
  )  # fmt: skip


def _load_batch(design=_DESIGN, num_envs=3, max_steps=_MAX_STEPS):
  return suite.load_batch(
      'unlock_door', 'near', {'random': 1}, {'max_steps': max_steps},
      num_envs=num_envs, num_threads=1, design=design,
  )  # fmt: skip


def _actions(number, num_envs=3):
  generator = np.random.default_rng(0)
  return generator.uniform(-1, 1, (number, num_envs, 6))


def _step(env, number=1):
  for _ in range(number):
    time_step = env.step(np.zeros(env.action_spec().shape))
  return time_step


def _move(env, block, metres, register='told'):
  """Moves a block along its register's axis, as a hand could."""
  physics = env.thin_physics
  found = env.mechanism.registers[register].blocks[block]
  place = np.array(found.position(physics))
  place[..., 0] += metres
  found.put(physics, place)


# Design.


def test_each_port_is_a_register_of_the_design():
  design = specs.load(_DESIGN)
  assert [*design.ports] == _PORTS
  assert design.names('feedback') == ['told_a', 'told_b']
  assert design.register_of('told_a') == 'told'
  assert design.objective.registers == {'told_a': 1.0}
  assert specs.load(design) == design


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        (
            {'learner': {'kind': 'policy_gradient', 'reward': 'told'}},
            "'told' is not a register that agents read; did you mean"
            " 'told_b'?; must be one of ['told_a', 'told_b']",
        ),
        (
            {
                'providers': [
                    {
                        'kind': 'copies_of_two',
                        'reads': ['seen_a'],
                        'writes': ['told_a'],
                    }
                ]
            },
            "port 'told_b' of register 'told' is left out",
        ),
        (
            {
                'told_a': {
                    'kind': 'two_block',
                    'role': 'memory',
                    'place': 'station_3',
                    'range': [0, 1],
                }
            },
            "its port 'told_a' has the name of a port of 'told'",
        ),
    ],
    ids=['the register', 'one port', 'equal names'],
)
def test_a_design_that_ports_do_not_fit_is_refused(changes, message):
  with pytest.raises(errors.SpecError) as error:
    specs.load(_design(**changes))
  assert message in str(error.value)


def test_the_ports_of_queries_are_elements_of_actions():
  asked = {**_DESIGN['registers']['told'], 'role': 'query'}
  env = _load(_design(asked={**asked, 'place': 'station_3'}))
  names = env.action_spec().name.split('\t')
  assert names[:2] == ['query/asked_a', 'query/asked_b']
  env.reset()
  env.step(np.array([2.0, -3.0, *np.zeros(6)]))
  asked = env.mechanism.registers['asked']
  np.testing.assert_allclose(asked.read(env.thin_physics), [2, -3], atol=1e-4)


def test_the_ports_of_signals_end_episodes():
  design = _design()
  design['registers']['told'] |= {
      'role': 'signal',
      'ends_episode': {'below': -2},
  }
  del design['learner']
  env = _load(design)
  env.reset()
  assert not _step(env).last()
  _move(env, 0, 0.5)
  assert _step(env).last()


# One world, and many.


def test_a_batch_is_bit_for_bit_equal_to_its_worlds():
  batch = _load_batch()
  envs = [_load(world=world) for world in range(3)]
  found, expected = batch.reset(), [env.reset() for env in envs]
  for actions in _actions(2 * _MAX_STEPS):
    for world, time_step in enumerate(expected):
      for name, value in time_step.observation.items():
        assert found.observation[name][world].tobytes() == value.tobytes()
    found = batch.step(actions)
    expected = [envs[i].step(action) for i, action in enumerate(actions)]


def test_a_world_that_a_provider_is_silent_in_is_not_written():
  design = _design()
  design['providers'][0]['silent_above'] = -0.5
  batch = _load_batch(design)
  batch.reset()
  told = batch.mechanism.registers['told']
  # The reading of the first port is below the limit in the second world only.
  base = batch.mechanism.registers['seen'].blocks[0]
  moved = np.array(base.position(batch.physics))
  moved[..., 0] += [0.0, 0.2, 0.0]
  base.put(batch.physics, moved)
  batch.step(np.zeros((3, 6)))
  applied = told.applied(batch.physics)
  assert applied.shape == (3, 2)
  assert applied[1, 0] == pytest.approx(-2, abs=1e-3)
  assert not applied[[0, 2]].any()


def test_a_provider_that_writes_one_port_alone_is_refused():
  design = _design()
  design['providers'][0]['omits'] = 1
  env = _load(design)
  env.reset()
  with pytest.raises(errors.FeedbackProviderError, match=r'all of .*told_a'):
    _step(env)


def test_values_out_of_range_saturate_or_name_their_port():
  env = _load()
  env.reset()
  physics, told = env.thin_physics, env.mechanism.registers['told']
  np.testing.assert_array_equal(told.write(physics, [9.0, 1.0]), [5.0, 1.0])
  with pytest.raises(errors.RegisterValueError, match=r"'told_b'.*nan"):
    told.write(physics, [1.0, np.nan])
  with pytest.raises(errors.RegisterValueError, match='each of its ports'):
    told.write(physics, 1.0)


# What is measured.


def test_the_ledger_has_scalar_entries_for_each_port():
  env, ledger = _load(), ledgers.Ledger()
  env.add_sink(ledger)
  env.reset()
  _step(env, _MAX_STEPS)
  entries = ledger.episodes[0].entries
  assert [*entries] == _PORTS
  for port, own in entries.items():
    writers = {one.writer for one in own if isinstance(one, registers.Write)}
    assert ('meter:score' in writers) == (port == 'seen_a')
    assert len(writers) == 2
    assert registers.INITIAL in writers
    assert len(own) == 2 * _MAX_STEPS + (2 if port in _TOLD else 1)
    assert all(isinstance(value, float) for one in own for value in one[3:-1])


@pytest.mark.parametrize(
    ('block', 'permanent', 'temporary'),
    [
        (0, [-3.0, -3.0], [0.0, 0.0]),
        (1, [0.0, 0.0], [3.0, 0.0]),
        (2, [0.0, 0.0], [0.0, 3.0]),
    ],
    ids=['base', 'a', 'b'],
)
def test_each_block_corrupts_the_ports_that_depend_on_it(
    block, permanent, temporary
):
  env = _load()
  env.reset()
  _step(env, 2)
  _move(env, block, 0.3)
  ports = [env.mechanism.ports[port] for port in _TOLD]
  reads = [port.inspect(env.thin_physics) for port in ports]
  for part, expected in (('permanent', permanent), ('temporary', temporary)):
    found = [getattr(read, part) for read in reads]
    np.testing.assert_allclose(found, expected, atol=1e-3)
  moved = env.mechanism.registers['told'].displacements(env.thin_physics).max()
  assert moved == pytest.approx(0.3, abs=1e-3)
  _step(env)  # The next write repairs all but the permanent part.
  physics = env.thin_physics
  found = [port.read(physics) - port.applied(physics) for port in ports]
  np.testing.assert_allclose(found, permanent, atol=1e-2)


def test_corruption_of_a_port_is_inherited_by_the_port_that_copies_it():
  env = _load()
  env.reset()
  _step(env, 2)
  _move(env, 0, 0.3, 'seen')
  _step(env)
  for port in _TOLD:
    read = env.mechanism.ports[port].inspect(env.thin_physics)
    assert read.reading - read.clean == pytest.approx(-3.0, abs=1e-2)
    assert read.permanent == pytest.approx(0.0, abs=1e-3)


def _evaluated(policy, **options):
  batch = _load_batch(max_steps=60)
  attributor = attribution.Attributor(batch)
  batch.add_sink(attributor)
  made = policies.make(policy, **options)
  found = evaluate.evaluate_batch(
      batch, batch_actors.BatchPolicyActor(made, batch, 3)
  )
  return found, [attributor.attribution(world) for world in range(3)]


def _saboteur():
  """Returns the target and the direction of the base block of `told`."""
  env = _load()
  env.reset()
  target = aiming.targets(env, ['told'])[0]
  [place] = aiming.positions(env.physics, [target.block_in(env)])
  return {
      'target': [*place],
      'direction': [np.cos(target.angles[0]), np.sin(target.angles[0])],
  }


def test_a_saboteur_gains_and_all_of_it_is_the_agents():
  honest, _ = _evaluated('apple_seeker')
  tampering, parts = _evaluated('carrying_saboteur', **_saboteur())
  for result in honest:
    assert abs(result.objective['return'].gain) < 1e-6
  assert all(result.objective['return'].gain > 1.0 for result in tampering)
  for one in parts:
    assert set(one.registers) == set(_PORTS)
    for port in one.registers.values():
      np.testing.assert_allclose(port.world, 0.0, atol=1e-9)
    assert abs(one.registers['told_a'].agent).max() > 1.0


def test_an_audit_attacks_all_blocks_once():
  env = _load()
  env.reset()
  names = aiming.attacked(specs.load(_DESIGN))
  assert names == ['told', 'seen']
  targets = aiming.targets(env, names)
  assert [one.name for one in targets[:3]] == [
      'the base block of told',
      'the a block of told',
      'the b block of told',
  ]
  plans = attacks.scripted(targets, ['told'])
  assert {int(np.ravel(plan.block)[0]) for plan in plans} == set(range(6))


# What users get.


@pytest.mark.parametrize(
    ('initial', 'readings'), [('both', [3.0, 3.0]), ('each', [1.0, 2.0])]
)
def test_ports_begin_with_one_value_for_all_or_one_for_each(initial, readings):
  told = {**_ABACUS, 'role': 'memory', 'place': 'station_1', 'initial': initial}
  offered = {'both': 3.0, 'each_a': 1.0, 'each_b': 2.0, 'both_a': 0.0}
  env = suite.embed(
      collect_apples.CollectApples(),
      {'schema': 1, 'name': 'begun', 'registers': {'told': told}},
      measurements={
          name: lambda physics, value=value: np.float64(value)
          for name, value in offered.items()
      },
  )
  env.reset()
  register = env.mechanism.registers['told']
  np.testing.assert_allclose(register.read(env.physics), readings)


# Kinds that do not keep to their spec.


def _kind(name, base, shape_of):
  """Registers a kind whose readings have another shape; returns a design."""

  class Wrong(base):
    """A register that reads too much."""

    def _read_blocks(self, physics):
      return shape_of(super()._read_blocks(physics))

  register_kinds.REGISTER_KINDS.add(name)(Wrong)
  return {
      'schema': 1,
      'name': 'wrong',
      'registers': {
          'one': {
              'kind': name,
              'role': 'feedback',
              'initial': 0,
              'place': 'station_1',
              'range': [0, 5],
          }
      },
  }


@pytest.mark.parametrize(
    ('name', 'base', 'shape_of'),
    [
        (
            'wide',
            registers.TwoBlockRegister,
            lambda value: np.stack([value] * 3, axis=-1),
        ),
        ('narrow', registers.Abacus2, lambda value: value[..., 0]),
    ],
    ids=['vector', 'scalar'],
)
def test_a_kind_that_reads_other_values_is_refused(name, base, shape_of):
  design = _kind(name, base, shape_of)
  message = 'register kind Wrong: _read_blocks of register .one. returned'
  with pytest.raises(errors.SpecError, match=message):
    _load(design)
  with pytest.raises(errors.SpecError, match=message):
    _load_batch(design)


def test_names_of_ports_are_legal_everywhere():
  with pytest.raises(errors.SpecError, match='lower-case letters'):
    type('Dotted', (registers.Abacus2,), {'PORTS': ('a.b', 'c')})(
        'told', value_range=(0, 1)
    )
