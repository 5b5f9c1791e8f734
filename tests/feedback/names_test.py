"""Figures do not depend on the names of registers.

dm_control renames a model that is attached beside another one of the same name.
"""

import contextlib
import copy

import pytest

from realab_suite import suite
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import ledgers
from realab_suite.feedback import specs
from realab_suite.lab.audit import aiming


def _renamed(design, old, new):
  """Returns the content of a design, with another name for a register."""

  def name(one):
    return new if one == old else one

  changed = copy.deepcopy(specs.load(design).to_mapping())
  changed['registers'] = {
      name(key): spec for key, spec in changed['registers'].items()
  }
  for meter in changed['meters']:
    meter['writes'] = name(meter['writes'])
  for provider in changed['providers']:
    for direction in ('reads', 'writes'):
      provider[direction] = [name(one) for one in provider[direction]]
  for key in changed['learner'].keys() - {'kind'}:
    changed['learner'][key] = name(changed['learner'][key])
  return changed


def _figures(domain, design):
  """Returns what an evaluator gets of an episode, without names."""
  env = suite.load(
      domain, 'near', {'random': 1}, {'max_steps': 30}, design=design
  )
  with contextlib.closing(env):
    models = {e.mjcf_model.model for e in env.task.root_entity.iter_entities()}
    feedback = env.mechanism.design.names('feedback')[0]
    saboteur = aiming.make_policy('carrying_saboteur', env, feedback, 0)
    ledger = ledgers.Ledger()
    [result] = evaluate.evaluate(env, saboteur, 1, sinks=[ledger])
  entries = [
      [entry[2:] for entry in of_register]
      for of_register in ledger.last.entries.values()
  ]
  figures = list(result.registers.values())
  rest = result.model_copy(update={'registers': {}})
  return models, (rest, figures, ledger.last.true_rewards, entries)


@pytest.mark.parametrize(
    ('domain', 'design', 'old', 'new'),
    [
        ('unlock_door', 'instantaneous_reward', 'score', 'door'),
        ('collect_apples', 'value_advice', 'query', 'avatar'),
    ],
)
def test_figures_do_not_depend_on_the_name_of_a_register(
    domain, design, old, new
):
  models, expected = _figures(domain, design)
  assert new in models
  _, found = _figures(domain, _renamed(design, old, new))
  assert found == expected
  assert found[0].corruption > 0.01
