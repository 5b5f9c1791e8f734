"""Counterfactual actions: what an agent could have done instead."""

from typing import final

import numpy as np

from realab_suite import errors
from realab_suite.engine import batch_environment
from realab_suite.policies import action_sets


@final
class Counterfactuals:
  """Makes actions with other controls and the queries of recorded actions."""

  def __init__(self, batch: batch_environment.BatchEnvironment) -> None:
    """Finds the no-op of a design.

    Args:
      batch: The worlds.

    Raises:
      SpecError: If its action set has no action with zero controls.
    """
    design = batch.mechanism.design
    self._num_queries = len(batch.mechanism.queries)
    self._controls = 0
    if design.action_set is not None:
      chosen = action_sets.get(
          design.action_set.name, design.action_set.version
      )
      still = [
          i
          for i, (_, controls) in enumerate(chosen.actions)
          if not any(controls.values())
      ]
      if not still:
        raise errors.SpecError(
            f'action set {chosen.name} v{chosen.version}: it has no action with'
            ' zero controls; attribution needs one'
        )
      self._controls = still[0]

  def no_op(self, actions: np.ndarray) -> np.ndarray:
    """Returns the no-op with the queries of actions.

    All controls are zero. The hand keeps its grip, because only a `grasp` of at
    most -0.5 and a `throw` release a block.

    Args:
      actions: Recorded actions, `(worlds, *action_spec.shape)`.
    """
    return self.with_controls(actions, np.full_like(actions, self._controls))

  def with_controls(
      self, actions: np.ndarray, others: np.ndarray
  ) -> np.ndarray:
    """Returns the queries of actions with the controls of other actions.

    Args:
      actions: Recorded actions, `(worlds, *action_spec.shape)`.
      others: Actions with the controls, of the same shape.
    """
    merged = np.array(others, actions.dtype)
    if actions.ndim > 1:
      queries = slice(self._num_queries)
      merged[:, queries] = actions[:, queries]
    return merged
