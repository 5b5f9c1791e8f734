"""Tests for features of classes of objects."""

from typing import Any

from dm_env import specs
import numpy as np
import pytest

from realab_suite.entities import appearance
from realab_suite.lab.agents import features

_DISTANCES, _CLASSES = 'senses/ray_distances', 'senses/ray_classes'


def _encoded(classes: specs.Array, values: list[int], **others: Any) -> Any:
  """Returns the encoder of a spec, and the features of one observation."""
  encoder = features.Encoder.from_spec({_CLASSES: classes, **others})
  observation = {_CLASSES: [values], _DISTANCES: np.zeros((1, len(values)))}
  packed = encoder.pack(observation, 1)
  return encoder, np.asarray(encoder.encode(packed)['vector'])


@pytest.mark.parametrize('has_distances', [True, False])
def test_only_listed_classes_have_features(has_distances: bool):
  others = {_DISTANCES: specs.Array((3,), np.float32)} if has_distances else {}
  listed = appearance.ClassArray((3,), (0, 1, 31))
  encoder, vector = _encoded(listed, [31, 0, 7], **others)
  assert encoder.vector_size == 9
  np.testing.assert_array_equal(vector, [[0, 0, 1, 1, 0, 0, 0, 0, 0]])
  # A server, for instance, sends bounds alone.
  bounded = specs.BoundedArray((3,), np.int32, 0, 31)
  encoder, vector = _encoded(bounded, [31, 0, 7], **others)
  assert encoder.vector_size == 3 * 32
  np.testing.assert_array_equal(np.flatnonzero(vector), [31, 32, 64 + 7])
