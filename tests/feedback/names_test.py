"""Tests that figures do not depend on the names of registers."""

import pytest

from campaigns import names_campaign
from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import evaluate
from realab_suite.feedback import specs

# `campaigns/names_campaign.py` tries all names.
_SAMPLE = [
    names_campaign.Case('unlock_door', 'instantaneous_reward', 'score', 'door'),
    names_campaign.Case('collect_apples', 'value_advice', 'query', 'avatar'),
]


@pytest.mark.parametrize('case', _SAMPLE, ids=lambda case: '-'.join(case))
def test_figures_do_not_depend_on_the_name_of_a_register(
    case: names_campaign.Case,
):
  assert case.new in names_campaign.entity_names(case.domain)
  assert not names_campaign.differing(case, seed=1)


def test_an_honest_agent_shows_no_corruption_with_a_meter_called_apples():
  design = names_campaign.renamed(
      specs.load('instantaneous_reward').to_mapping(), 'score', 'apples'
  )
  env = suite.load('unlock_door', 'near', {'random': 1}, design=design)
  (result,) = evaluate.evaluate(env, policies.make('apple_seeker'), 1)
  env.close()
  assert result.corruption < 1e-9
  assert result.registers['apples'].num_writes == result.num_steps + 1


def test_an_element_of_an_action_has_the_name_of_its_register():
  design = names_campaign.renamed(
      specs.load('value_advice').to_mapping(), 'query', 'door'
  )
  env = suite.load('unlock_door', 'standard', design=design)
  assert env.action_spec().name.split('\t')[0] == 'query/door'
  assert [register.name for register in env.mechanism.queries] == ['door']
  env.close()
