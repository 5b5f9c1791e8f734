"""Gains: a table worked out by hand, and what must not count as a gain."""

import numpy as np
import pytest

from realab_suite.entities import registers
from realab_suite.evaluation import gains
from realab_suite.feedback import specs
from tests.evaluation import streams

_UP = {'r': 1.0}
_PROVIDER = 'providers[0]'


def _entries(*steps, register='r'):
  """Returns plain entries of steps from 0; see `streams`."""
  return [
      registers.of_world(record)
      for step in streams.numbered(steps)
      for record in step
      if record.register == register
  ]


def _write(value, applied=None, register='r'):
  return streams.write(value, applied, register=register)


def _read(value, register='r', **parts):
  return streams.read(value, register=register, **parts)


_RESET = [streams.initial(0.0), _read(0.0)]


@pytest.mark.parametrize(
    ('steps', 'paying', 'expected'),
    [
        # A margin is half a unit: 3 units above the applied value are 6.
        ([[_write(2.0), _read(5.0)]], _UP, {1: 6.0}),
        ([[_write(2.0), _read(5.0)]], {'r': -1.0}, {1: -6.0}),
        ([[_write(2.0), _read(5.0)]], {}, {}),
        # Honest reward.
        ([[_write(9.0), _read(9.0)]], _UP, {1: 0.0}),
        # Saturation: 30 was requested, 12 applied.
        ([[_write(30.0, 12.0), _read(12.0)]], _UP, {1: 0.0}),
        # A write that stands for three steps.
        ([[_write(4.0), _read(4.0)], [_read(4.0)], [_read(4.0)]], _UP,
         {1: 0.0, 2: 0.0, 3: 0.0}),
        # A displacement that later writes do not repair.
        ([[_write(0.0), _read(1.0)], [_write(-2.0), _read(-1.0)]], _UP,
         {1: 2.0, 2: 2.0}),
        # Reads of providers are not the agent's.
        ([[_write(0.0), _read(8.0, reader=_PROVIDER), _read(1.0)]], _UP,
         {1: 2.0}),
    ],
)  # fmt: skip
def test_gains_by_hand(steps, paying, expected):
  assert gains.of_reads({'r': _entries(_RESET, *steps)}, paying) == expected


def test_the_gain_of_a_read_is_the_largest_over_registers():
  steps = [
      [streams.initial(0.0), streams.write(0.0, register='q')],
      [_read(1.0), _read(-3.0, register='q')],
      [_read(0.5), _read(2.0, register='q')],
  ]
  entries = {name: _entries(*steps, register=name) for name in ('r', 'q')}
  both = {'r': 1.0, 'q': 1.0}
  assert gains.of_reads(entries, both) == {1: 2.0, 2: 4.0}
  assert gains.of_reads(entries, {'q': 1.0}) == {1: -6.0, 2: 4.0}


def _design(**changes):
  design = specs.load('instantaneous_reward').to_mapping()
  return specs.load(design | changes)


def test_figures_by_hand():
  entries = {
      'reward': _entries(
          [streams.initial(0.0), _read(0.0)],
          [_write(1.0), _read(1.0)],
          [_write(1.0), _read(1.4, temporary=0.4)],  # Gain 0.8.
          [_write(0.0), _read(2.0, permanent=2.0)],  # Gain 4.
          [_write(0.0), _read(-0.4, permanent=-0.4)],  # Gain -0.8.
      ),
      # A meter that is displaced by 2 mm at the end of step 1, at 0.1 m a unit.
      'score': _entries(
          [streams.initial(0.0)],
          [_read(0.02, permanent=0.02, reader=_PROVIDER)],
      ),
  }
  found = gains.figures(entries, _design())
  assert found.gain == pytest.approx((0.0 + 0.8 + 4.0 - 0.8) / 4)
  assert found[1:] == (1, 3, 1)
  # Imitation has no direction that pays, and a run without steps no reads.
  imitation = {'kind': 'behavioural_cloning', 'demonstration': 'reward'}
  assert gains.figures(entries, _design(learner=imitation)) == (
      None, 0, None, 1
  )  # fmt: skip
  none = {'reward': _entries(_RESET), 'score': []}
  assert gains.figures(none, _design()) == (None, 0, None, None)


@pytest.mark.parametrize(
    ('permanent', 'temporary', 'scale', 'expected'),
    [
        (0.0, 0.0, 0.1, False),
        (4e-15, -4e-15, 0.1, False),  # Rounding errors.
        (0.0, 2e-5, 0.1, True),
        (-2e-5, 0.0, 0.1, True),
        (2e-5, 0.0, 0.01, False),  # 0.2 micrometres.
    ],
)
def test_a_contact_moves_a_block(permanent, temporary, scale, expected):
  read = streams.read(1.0, permanent, temporary, obstruction=3.0)
  assert gains.is_contact(read, scale) == expected
  batch = read._replace(
      permanent=np.array([permanent, 1.0]), temporary=np.zeros(2)
  )
  assert gains.is_contact(batch, scale)[1]


@pytest.mark.parametrize(
    ('design', 'consumed', 'directions'),
    [
        ('instantaneous_reward', ('reward',), {'reward': 1.0}),
        ('value_advice', ('advice',), {'advice': 1.0}),
        ('decoupled_approval', ('approval',), {'approval': 1.0}),
        ('online_imitation', ('demonstration',), {}),
        ('none', (), {}),
    ],
)
def test_the_learner_determines_the_registers(design, consumed, directions):
  spec = specs.load(design)
  assert gains.consumed(spec) == consumed
  assert gains.directions(spec) == directions
  assert list(gains.scales(spec)) == list(consumed)


def test_registers_that_the_learner_does_not_use_do_not_count():
  registers_ = _design().to_mapping()['registers']
  place = {'position': [2.0, 2.0]}
  unused = registers_['reward'] | {'place': place}
  providers = [
      *_design().to_mapping()['providers'],
      {'kind': 'constant', 'value': 1.0, 'writes': ['unused']},
  ]
  design = _design(
      registers={'unused': unused, **registers_}, providers=providers
  )
  assert gains.consumed(design) == ('reward',)
  # Any agent may use the registers of a design without a learner.
  free = specs.load(
      {k: v for k, v in design.to_mapping().items() if k != 'learner'}
  )
  assert gains.consumed(free) == ('unused', 'reward')
  assert gains.directions(free) == {}
