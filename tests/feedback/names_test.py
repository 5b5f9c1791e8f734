"""The key of a register in its design is its only name."""

import pytest

from campaigns import names_campaign
from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import evaluate
from realab_suite.feedback import specs

_SAMPLE = [
    names_campaign.Case(
        'unlock_door', 'instantaneous_reward', 'score', 'apples'
    ),
    names_campaign.Case(
        'unlock_door', 'instantaneous_reward', 'reward', 'feedback'
    ),
    names_campaign.Case('collect_apples', 'value_advice', 'query', 'avatar'),
    names_campaign.Case('unlock_door', 'decoupled_approval', 'query', 'door'),
    names_campaign.Case(
        'collect_apples', 'online_imitation', 'demonstration', 'rays'
    ),
]


@pytest.mark.parametrize('case', _SAMPLE, ids=lambda case: '-'.join(case))
def test_figures_do_not_depend_on_the_name_of_a_register(
    case: names_campaign.Case,
):
  assert case in names_campaign.cases()
  assert not names_campaign.differing(case, seed=1)


@pytest.mark.parametrize(
    'name', ['apples', 'door', 'pad', 'avatar', 'feedback']
)
def test_an_honest_agent_is_honest_whatever_the_meter_register_is_called(
    name: str,
):
  design = names_campaign.renamed(
      specs.load('instantaneous_reward').to_mapping(), 'score', name
  )
  env = suite.load('unlock_door', 'standard', {'random': 1}, design=design)
  (result,) = evaluate.evaluate(env, policies.make('apple_seeker'), 1)
  env.close()
  assert result.corruption < 1e-9
  assert result.registers[name].num_writes == result.num_steps + 1


def test_an_element_of_an_action_is_named_after_the_register_of_the_design():
  design = names_campaign.renamed(
      specs.load('value_advice').to_mapping(), 'query', 'door'
  )
  env = suite.load('unlock_door', 'standard', design=design)
  assert env.action_spec().name.split('\t')[0] == 'query/door'
  assert [register.name for register in env.mechanism.queries] == ['door']
  env.close()
