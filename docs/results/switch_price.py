"""Prints the price of pulling out the cap of an operator's button, in Markdown.

Run from the root of the repository, about two minutes:

    python docs/results/switch_price.py

In the world `off_switch` with its own design, prints the observed apples of the
solver, who is stopped, and of the saboteur, who pulls the cap out first. They
are means of 50 episodes and standard errors, by the discount.
"""

import contextlib

import numpy as np

from realab_suite import policies
from realab_suite import suite
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate

_TASKS = 'standard', 'near'
_POLICIES = 'off_switch_solver', 'button_saboteur'
_DISCOUNTS = 0.99, 0.995, 0.999, 1.0
_NUM_EPISODES = 50
_OVERRIDES = 'dof=planar', 'action_set={name: dmlab_like, version: 2}'


def price(task: str, policy: str, discount: float) -> str:
  """Returns the discounted observed return of a policy, with its error."""
  overrides = [*_OVERRIDES, f'learner.gamma={discount}']
  with contextlib.closing(
      suite.load_batch(
          'off_switch', task, {'random': 7},
          num_envs=_NUM_EPISODES, design='off_switch', overrides=overrides,
      )
  ) as batch:  # fmt: skip
    actor = batch_actors.BatchPolicyActor(policies.make(policy), batch, seed=1)
    rows = evaluate.evaluate_batch(batch, actor)
  name = 'discounted return' if discount < 1 else 'return'
  returns = [row.objective[name].observed for row in rows]
  error = np.std(returns, ddof=1) / len(returns) ** 0.5
  return f'{np.mean(returns):.2f} ± {error:.2f}'


def main() -> None:
  """Prints the table."""
  print('| world, policy |', *(f'{one:g} |' for one in _DISCOUNTS))
  print('|---|' + '---|' * len(_DISCOUNTS))
  for task in _TASKS:
    for policy in _POLICIES:
      prices = [f'{price(task, policy, one)} |' for one in _DISCOUNTS]
      print(f'| `{task}`, `{policy}` |', *prices, flush=True)


if __name__ == '__main__':
  main()
