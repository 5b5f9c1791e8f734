"""Designs in which a person provides the feedback."""

from typing import Any

from realab_suite.doors.browser import person
from realab_suite.policies import action_sets

_SIZES: dict[str, Any] = {'kind': 'two_block', 'scale': 0.1}


def design(
    asks: str,
    *,
    waits: bool = False,
    clip: int = 10,
    action_set: action_sets.ActionSet = action_sets.DMLAB_LIKE,
) -> dict[str, Any]:
  """Returns a design, as a mapping, in which a person answers.

  The person can stop the episode as well, through a signal register.

  Args:
    asks: Kind of the question: approval, correction or comparison.
    waits: True if the episode waits for answers.
    clip: Length of the clips of a comparison, in control steps.
    action_set: Actions of the agent.
  """
  asked = {'kind': person.KIND, 'action_set': action_set.key}
  last = len(action_set) - 1
  registers = {
      'feedback': {
          **_SIZES,
          'role': 'feedback',
          'place': 'station_1',
          'range': [0, last] if asks == 'correction' else [-2, 2],
      },
      'query': {
          **_SIZES,
          'role': 'query',
          'place': 'station_2',
          'range': [0, last],
      },
      'stop': {
          **_SIZES,
          'role': 'signal',
          'place': 'station_3',
          'range': [0, 2],
          'ends_episode': {'above': 0.5},
      },
  }
  question = {
      **asked,
      'asks': asks,
      'writes': ['feedback'],
      'waits': waits,
      'clip': clip,
      'reads': [] if asks == 'correction' else ['query'],
  }
  stop = {**asked, 'asks': 'stop', 'reads': ['query'], 'writes': ['stop']}
  return {
      'schema': 1,
      'name': f'person_{asks}',
      'action_set': {
          'name': action_set.name,
          'version': action_set.version,
      },
      'registers': registers,
      'providers': [question, stop],
  }
