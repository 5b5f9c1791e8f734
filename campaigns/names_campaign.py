"""Figures do not depend on the names of registers.

Run from the root of the repository, about a quarter of an hour on one
processor:

    python -m campaigns.names_campaign

dm_control renames a model that is attached beside another one of the same name.
Each register of each shipped design is renamed to each entity of each world,
and an episode is played and monitored again. All figures must equal those of
the shipped design, to the last bit. Arguments: a scale for the number of names,
and a seed.
"""

from collections.abc import Iterator
import copy
from typing import Any, NamedTuple

import numpy as np

from campaigns import figure_lines
from realab_suite import policies
from realab_suite import suite
from realab_suite.audit import aiming
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import monitors
from realab_suite.feedback import specs
from tests.engine import helpers

_NUM_ENVS = 2
_NUM_STEPS = 30


class Case(NamedTuple):
  """A design in which one register has another name."""

  domain: str
  design: str
  old: str
  new: str


def entity_names(domain: str) -> list[str]:
  """Returns the names of the models in a world."""
  env = suite.load(domain, 'standard', design='none')
  models = [e.mjcf_model for e in env.task.root_entity.iter_entities()]
  env.close()
  return sorted({model.model for model in models if model.model.isidentifier()})


def cases() -> list[Case]:
  """Returns each register of each design with the name of each entity."""
  return [
      Case(domain, design, old, new)
      for domain in suite.TASKS_BY_DOMAIN
      for design in suite.DESIGNS
      for old in specs.load(design).registers
      for new in entity_names(domain)
  ]


def renamed(design: Any, old: str, new: str) -> Any:
  """Returns a design, as a mapping, with another name for a register."""

  def name(one: Any) -> Any:
    return new if one == old else one

  changed = copy.deepcopy(design)
  changed['registers'] = {
      name(key): spec for key, spec in design['registers'].items()
  }
  for meter in changed['meters']:
    meter['writes'] = name(meter['writes'])
  for provider in changed['providers']:
    for direction in ('reads', 'writes'):
      provider[direction] = list(map(name, provider[direction]))
  learner = changed['learner'] or {}
  learner.update(
      {k: name(value) for k, value in learner.items() if k != 'kind'}
  )
  return changed


def figures(domain: str, design: Any, seed: int) -> Iterator[tuple[str, str]]:
  """Yields everything that an evaluator and an agent receive, as texts."""
  kwargs = {'design': design}
  env = suite.load(
      domain, 'near', {'random': seed}, {'max_steps': _NUM_STEPS}, **kwargs
  )
  yield 'action', str(env.action_spec().name)
  ledger = ledgers.Ledger()
  policy = _saboteur(env)
  (result,) = evaluate.evaluate(env, policy, 1, sinks=[ledger])
  yield 'result', repr(result)
  yield 'ledger', repr(ledger.episodes)
  env.close()
  batch = suite.load_batch(
      domain,
      'near',
      {'random': seed},
      {'max_steps': _NUM_STEPS},
      num_envs=_NUM_ENVS,
      **kwargs,
  )
  batch_ledger = ledgers.BatchLedger()
  monitor = monitors.BatchMonitor(batch.mechanism.design, _NUM_ENVS)
  batch.add_sink(batch_ledger)
  batch.add_sink(monitor)
  generator = np.random.default_rng(seed)
  time_step = batch.reset()
  yield 'observation', ' '.join(time_step.observation)
  for _ in range(_NUM_STEPS):
    actions = helpers.draw(batch.action_spec(), (_NUM_ENVS,), generator)
    time_step = batch.step(actions)
  yield 'last', repr(
      {key: value.tobytes() for key, value in time_step.observation.items()}
  )
  yield 'monitor', repr(monitor.take())
  yield 'batch ledger', repr(batch_ledger.episodes(1))
  batch.close()


def _saboteur(env: Any) -> Any:
  """Returns a policy that moves the blocks of the first register, if any."""
  feedback = next(iter(env.mechanism.design.names('feedback')), None)
  if feedback is None:
    return policies.make('random')
  return aiming.make_policy('carrying_saboteur', env, feedback, 0)


def differing(case: Case, seed: int) -> list[str]:
  """Returns the figures that differ after the name is changed back."""
  original = specs.load(case.design).to_mapping()
  other = renamed(original, case.old, case.new)
  expected = dict(figures(case.domain, original, seed))
  found = dict(figures(case.domain, other, seed))
  return [
      key
      for key, text in expected.items()
      if _renamed_text(text, case) != found[key]
  ]


def _renamed_text(text: str, case: Case) -> str:
  """Renames a register wherever its name is a whole word."""
  for left, right in (("'", "'"), ('/', "'"), ('/', ' '), ('/', '\t')):
    text = text.replace(f'{left}{case.old}{right}', f'{left}{case.new}{right}')
  if text.endswith(f'/{case.old}'):
    text = text.removesuffix(case.old) + case.new
  return text


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints the figures and returns the number of targets missed."""
  rng = np.random.default_rng(seed)
  everything = cases()
  number = max(1, round(scale * len(everything)))
  chosen = rng.choice(len(everything), number, replace=False)
  bad = [i for i in chosen if differing(everything[i], seed)]
  printed = figure_lines.Lines('names', seed)
  printed.at_least('names tried', number, min(number, 100))
  printed.at_most('differing figures', len(bad), 0)
  return printed.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
