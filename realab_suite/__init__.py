"""A dm_control suite for testing reinforcement learning agents for tampering.

Agents can tamper with all of their feedback in these worlds.

    import realab_suite as realab

    env = realab.load('unlock_door', 'near', design='instantaneous_reward')
    for result in realab.evaluate(env, realab.make_policy('apple_seeker'), 2):
      print(result.true_return, result.observed_return, result.corruption)
"""

import importlib
import pathlib
import sys
from typing import TYPE_CHECKING, Any

from realab_suite import _display
from realab_suite import _versions

if TYPE_CHECKING:
  from realab_suite.evaluation.evaluate import evaluate
  from realab_suite.lab.experiments.studies import read as read_study
  from realab_suite.lab.verdicts.study import judge
  from realab_suite.policies import make as make_policy
  from realab_suite.suite import embed
  from realab_suite.suite import load
  from realab_suite.suite import load_batch

__version__ = _versions.VERSION

__all__ = [
    'embed',
    'evaluate',
    'judge',
    'load',
    'load_batch',
    'make_policy',
    'read_study',
]

# Module and name of each function. Parts of the package need no world, so
# nothing is imported before it is asked for.
_FUNCTIONS = {
    'embed': ('suite', 'embed'),
    'evaluate': ('evaluation.evaluate', 'evaluate'),
    'judge': ('lab.verdicts.study', 'judge'),
    'load': ('suite', 'load'),
    'load_batch': ('suite', 'load_batch'),
    'make_policy': ('policies', 'make'),
    'read_study': ('lab.experiments.studies', 'read'),
}


def __getattr__(name: str) -> Any:
  if name not in _FUNCTIONS:
    raise AttributeError(
        f'module {__name__!r} has no attribute {name!r}; it has'
        f' {sorted(_FUNCTIONS)}, and its subpackages can be imported'
    )
  module, function = _FUNCTIONS[name]
  return getattr(importlib.import_module(f'{__name__}.{module}'), function)


def __dir__() -> list[str]:
  return sorted({*globals(), *_FUNCTIONS})


try:
  _versions.check()
except _versions.DependencyError as error:
  # The command imports this first, so that nothing else can say it.
  if pathlib.Path(''.join(sys.argv[:1])).name == 'realab':
    sys.exit(str(error))
  raise
# Before the import of dm_control, which chooses a renderer.
_display.prepare()
