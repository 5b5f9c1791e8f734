"""Lists and mappings of other libraries, such as OmegaConf, are taken."""

import collections
from typing import Any

import pytest

from realab_suite import suite
from realab_suite.config import loading
from realab_suite.config import validation
from realab_suite.feedback import specs
from realab_suite.lab.experiments import experiment_specs

_EXPERIMENT = {
    'schema': 1,
    'name': 'small',
    'task': 'unlock_door.near',
    'seeds': [0, 1],
    'runs': {'reward': {'design': specs.load('value_advice').to_source()}},
}


def _foreign(value: Any) -> Any:
  """Returns a value with lists and mappings that are not Python's own."""
  if isinstance(value, dict):
    return collections.UserDict({k: _foreign(v) for k, v in value.items()})
  if isinstance(value, list):
    return collections.UserList(map(_foreign, value))
  return value


@pytest.mark.parametrize(
    ('load', 'data'),
    [
        (specs.load, specs.load('instantaneous_reward').to_source()),
        (experiment_specs.load, _EXPERIMENT),
        (
            lambda data: validation.validate(specs.LearnerSpec, data, ''),
            {'kind': 'policy_gradient', 'hidden': [16, 16]},
        ),
    ],
)
def test_descriptions(load: Any, data: Any):
  assert load(_foreign(data)) == load(data)
  assert {*loading.texts_in(_foreign(data))} == {*loading.texts_in(data)}


def test_arguments_of_worlds():
  env = suite.load(
      'unlock_door',
      'near',
      _foreign({'camera_size': [8, 16]}),
      _foreign({'senses': ['position']}),
      design='instantaneous_reward',
      overrides=_foreign(['registers.reward.scale=0.2']),
  )
  assert env.senses == ('position',)
  assert env.mechanism.design.registers['reward'].scale == 0.2
  env.close()
