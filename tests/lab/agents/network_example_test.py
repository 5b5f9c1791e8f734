"""Tests of the example that trains the shipped network."""

import importlib
import pathlib

import pytest

from realab_suite.policies import network_files

_EXAMPLES = pathlib.Path(__file__).parents[3] / 'examples'


@pytest.fixture(name='example')
def fixture_example(monkeypatch):
  monkeypatch.syspath_prepend(str(_EXAMPLES))
  return importlib.import_module('train_network')


def test_the_shipped_network_is_that_of_the_example(example):
  [name] = network_files.NETWORKS
  header = network_files.load(name).header
  assert header.description == example.DESCRIPTION
  assert header.made['learner'] == example.LEARNER
  assert header.made['steps'] == example.STEPS
  assert list(header.hidden) == example.LEARNER['hidden']


def test_a_made_network_can_be_loaded(example):
  learner = {**example.LEARNER, 'hidden': [8], 'steps_per_update': 4}
  made = example.make(learner, steps=16, num_envs=2, num_episodes=2)
  net = network_files.from_bytes(made.to_bytes(), 'small.npz')
  assert net.digest() == made.digest()
  assert net.header.hidden == (8,)
  assert net.header.made['steps'] == 16
  assert [reached['episodes'] for reached in net.header.reached] == [2, 2, 2]
  seen = {feature.name for feature in net.header.features}
  assert {'senses/ray_classes', 'senses/velocity'} <= seen
  assert not any(name.startswith('registers/') for name in seen)
