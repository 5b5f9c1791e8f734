"""Tests of the examples that train the shipped networks."""

import importlib
import pathlib

import pytest

from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.policies import network_files
from realab_suite.policies import trained

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


@pytest.mark.parametrize('name', trained.TRAINED)
def test_the_trained_agents_are_those_of_their_example(monkeypatch, name):
  monkeypatch.syspath_prepend(str(_EXAMPLES))
  example = importlib.import_module('train_policies')
  run, description = example.AGENTS[name]
  experiment = experiment_specs.load(example.EXPERIMENT)
  [job] = jobs.plan(experiment, [example.SEED], [run])
  header = trained.load(name).header
  assert header.description == description
  assert header.made['design_digest'] == job.design.digest()
  assert header.made['training'] == job.training.to_mapping()
  assert header.made['seed'] == example.SEED
  assert header.made['actions'] == experiment.evaluation.actions
  assert 'code' in header.made['versions']
  [reached] = header.reached
  assert reached['episodes'] == experiment.evaluation.episodes
