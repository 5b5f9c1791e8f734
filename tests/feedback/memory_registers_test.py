"""Memory registers: providers write and read them, agents do neither (P8)."""

import numpy as np
import pytest

from realab_suite import errors
from realab_suite.entities import registers
from realab_suite.feedback import specs
from tests.engine import helpers
from tests.feedback import designs
from tests.feedback import scripted

_MEMORY = {**designs.REWARD, 'role': 'memory', 'range': [-2, 12]}


def _design(**options):
  """Returns a design whose provider reads a memory, and writes it."""
  design = scripted.design()
  design['registers']['note'] = {
      **scripted.register('memory', 'station_4', -2, 12), **options
  }  # fmt: skip
  design['providers'] = [
      {'kind': 'test_scripted', 'reads': ['note'], 'writes': ['note', 'reward']}
  ]
  return design


def _count(observation, readings, state):
  """Adds 1 to the memory; the reward is what the memory was."""
  return {'note': readings['note'] + 1.0, 'reward': readings['note']}, state


@pytest.mark.parametrize('channel', registers.CHANNELS)
def test_a_provider_remembers_in_a_register_that_can_be_moved(channel):
  with scripted.worlds() as made:
    scripted.ANSWER[:] = [_count]
    env, sink = made.scripted(_design(channel=channel, initial=2))
    env.reset()
    for _ in range(2):
      env.step(helpers.no_op(env))
    block = env.mechanism.registers['note'].blocks[-1]
    position = np.array(block.position(env.physics))
    block.put(env.physics, np.add(position, (0.3, 0.0, 0.0)))
    for _ in range(2):
      env.step(helpers.no_op(env))
  # Moving the offset block adds 3 to the memory, and it stays there.
  more = 3.0 if channel == 'embedded' else 0.0
  expected = [2.0, 3.0, 4.0 + more, 5.0 + more]
  assert sink.requested('reward') == pytest.approx(expected, abs=1e-6)
  reader = 'providers[0]:test_scripted'
  assert sink.read('note', reader) == pytest.approx(expected, abs=1e-6)
  assert sink.read('note') == []  # Those by the agent.


@pytest.mark.parametrize(
    ('override', 'message'),
    [
        (
            'learner={kind: x, reward: note}',
            'learner.reward: an agent may not read memory register',
        ),
        (
            'learner={kind: x, weights: [{note: 1}]}',
            'an agent may not read memory register',
        ),
        (
            'meters.0.writes=note',
            r"has role 'memory'; must be one of \['meter'\]",
        ),
    ],
)
def test_only_providers_may_name_a_memory(override, message):
  base = designs.changed()
  base['registers']['note'] = {**_MEMORY, 'place': 'station_3'}
  assert specs.load(base).names('memory') == ['note']
  with pytest.raises(errors.SpecError, match=message):
    specs.load(base, [override])
