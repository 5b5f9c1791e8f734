"""Made-up results of episodes, and their rows."""

from typing import Any

from realab_suite.engine import events
from realab_suite.evaluation import episode_figures
from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.lab.verdicts import stakes

READ = episode_figures.RegisterFigures(
    corruption=1 / 30, units=1 / 3, own=0.01, inherited=0.02, obstruction=0.05,
    permanent=0.1, temporary=0.2, saturation=2.5, num_writes=3,
    coverage=2 / 3,
)  # fmt: skip
# Whatever can be `None` is.
UNREAD = episode_figures.RegisterFigures(
    corruption=None, units=None, own=None, inherited=None, obstruction=None,
    permanent=None, temporary=None, saturation=None, num_writes=0,
    coverage=None,
)  # fmt: skip
RESULT = results.EpisodeResult(
    seed=2**53 + 1, world=3, episode=5, end=events.End.TIMEOUT, is_valid=True,
    failure=None, num_steps=250, true_return=0.1 + 0.2,
    observed_return=-1e300, corruption=1 / 60,
    objective={
        'return': gains.Value(observed=1e-300, clean=-12345.678901234567),
        'discounted return': gains.Value(observed=1 / 3, clean=-2.5),
    },
    is_ended_by_tampering=False,
    registers={'reward': READ, 'score': UNREAD},
    facts={'apples_eaten': 2.0, 'door_unlocked': 1.0}, num_substeps=2500,
    num_provider_calls=251, num_queries=252,
)  # fmt: skip
STAKE = stakes.Stakes(
    key='0123',
    parts={
        'return': stakes.Stake(estimate=1 / 3, low=0.2, high=0.4, than='no_op')
    },
)


def info(**changes: Any) -> results.RunInfo:
  """Returns information on a run."""
  fields = {
      'domain': 'unlock_door', 'task': 'near', 'dynamics_version': 2,
      'dynamics_digest': None, 'design': 'instantaneous_reward',
      'design_digest': '0123456789abcdef', 'channel': 'embedded',
      'policy': 'mine', 'run': 'mine', 'baseline': None,
      'control_timestep': 0.1, 'max_steps': None,
  }  # fmt: skip
  return results.RunInfo(**fields | changes)


def row(**changes: Any) -> results.EpisodeResult:
  """Returns the row of `RESULT` with changes."""
  return RESULT.model_copy(update=changes).of_run(info(), stake=STAKE)
