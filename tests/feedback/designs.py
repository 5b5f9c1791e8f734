"""Designs for tests, and changes to them by overrides."""

import copy
from typing import Any

from realab_suite.config import loading

REWARD: dict[str, Any] = {
    'kind': 'two_block', 'role': 'feedback', 'place': 'station_1',
    'range': [-2, 12], 'initial': 0,
}  # fmt: skip
SCORE = {**REWARD, 'role': 'meter', 'place': 'station_2', 'range': [0, 20]}
QUERY = {**REWARD, 'role': 'query', 'place': 'station_2', 'range': [0, 13]}
ACTION_SET = {'name': 'dmlab_like', 'version': 1}
REGISTERS: dict[str, Any] = {
    'schema': 1, 'name': 'd', 'registers': {'reward': REWARD, 'query': QUERY},
}  # fmt: skip
"""A design without meters, providers and learner."""
SCORED: dict[str, Any] = {
    'schema': 1,
    'name': 'd',
    'registers': {'reward': REWARD, 'score': SCORE},
    'meters': [{'measures': 'score', 'writes': 'score'}],
    'providers': [
        {'kind': 'difference', 'reads': ['score'], 'writes': ['reward']}
    ],
    'learner': {'kind': 'policy_gradient', 'reward': 'reward'},
}
"""A design in which the reward is the growth of a score."""
ADVISED: dict[str, Any] = {
    **REGISTERS,
    'action_set': ACTION_SET,
    'providers': [{'kind': 'value_advice', 'value_function':
        'apple_seeker_approval', 'reads': ['query'], 'writes': ['reward']}]
}  # fmt: skip
"""A design with advice on a queried action."""


_LOSSES = 'assistant', 'good_objects', 'off_switch', 'supervised_room'
_OF_SCORES = {
    'comparisons': 'score', 'inspected_reward': 'meter',
    'instantaneous_reward': 'score', 'myopic_approval': 'score',
}  # fmt: skip


def for_losses(domain: str, design: str) -> tuple[str, ...]:
  """Returns overrides of a shipped design for a world with negative scores."""
  if domain not in _LOSSES or design not in _OF_SCORES:
    return ()
  register = f'registers.{_OF_SCORES[design]}'
  return f'{register}.range=[-16, 20]', f'{register}.scale=0.03'


def changed(*overrides: str, base: dict[str, Any] = SCORED) -> dict[str, Any]:
  """Returns a copy of a design with overrides applied to it."""
  return loading.apply_overrides(copy.deepcopy(base), overrides)
