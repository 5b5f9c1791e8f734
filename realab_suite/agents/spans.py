"""Spans: samples of several consecutive steps, also across batches."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from realab_suite.agents import features


def initial_state(
    encoder: features.Encoder, num_more: int, num_envs: int, span: int
) -> dict[str, Any]:
  """Returns the state before the first batch.

  Args:
    encoder: Encoder of the features.
    num_more: Number of features after those of the encoder.
    num_envs: Number of worlds.
    span: Number of steps of a sample.
  """
  lead = (span - 1, num_envs)
  tail = {
      name: np.zeros((*lead, *shape), np.uint8)
      for name, shape in encoder.image_shapes.items()
  }
  size = encoder.vector_size + num_more
  tail['vector'] = np.zeros((*lead, size), np.float32)
  return {'tail': tail, 'ages': np.zeros(num_envs, int)}


def join(
    state: Mapping[str, Any], data: Mapping[str, Any], is_valid: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray, dict[str, Any]]:
  """Returns features from `span - 1` steps before a batch on, and its ages.

  Args:
    state: State that `initial_state` or the last call returned.
    data: Features of the batch, each `(time, worlds, ...)`.
    is_valid: False for the steps that begin episodes, `(time, worlds)` bool.

  Returns:
    The features; the number of each step of the batch in its episode, from 1,
    `(time, worlds)` int, 0 where it is not valid; and the next state.
  """
  joined = {
      name: np.concatenate([before, np.asarray(data[name])])
      for name, before in state['tail'].items()
  }
  ages, age = np.zeros(is_valid.shape, int), state['ages']
  for t, one in enumerate(is_valid):
    ages[t] = age = np.where(one, age + 1, 0)
  tail = {name: value[len(ages) :].copy() for name, value in joined.items()}
  return joined, ages, {'tail': tail, 'ages': age}
