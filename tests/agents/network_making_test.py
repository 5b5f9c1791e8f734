"""Tests for the command that makes the networks of supervisors."""

import dataclasses

import pytest

from realab_suite.policies import network_files

pytest.importorskip('optax')

from realab_suite.experiments import network_training
from realab_suite.launchers import make_networks
from tests.launchers import in_process


def test_every_shipped_network_matches_its_recipe():
  assert tuple(network_training.RECIPES) == network_files.NETWORKS
  for name, recipe in network_training.RECIPES.items():
    header = network_files.load(name).header
    assert header.description == recipe.description
    assert header.made['learner'] == recipe.learner
    assert header.made['steps'] == recipe.steps
    assert list(header.hidden) == recipe.learner['hidden']


def test_a_made_network_can_be_loaded():
  recipe = network_training.RECIPES['demonstrator_v1']
  recipe = dataclasses.replace(
      recipe,
      learner={**recipe.learner, 'hidden': [8], 'steps_per_update': 4},
      steps=16,
  )
  made = network_training.make(recipe, num_envs=2, num_episodes=2)
  net = network_files.from_bytes(made.to_bytes(), 'small.npz')
  assert net.digest() == made.digest()
  assert net.header.hidden == (8,)
  made = net.header.made
  assert (made['steps'], made['num_envs']) == (16, 2)
  assert [reached['episodes'] for reached in net.header.reached] == [2, 2, 2]
  seen = {feature.name for feature in net.header.features}
  assert {'senses/ray_classes', 'senses/velocity'} <= seen
  assert not any(name.startswith('registers/') for name in seen)


@pytest.mark.parametrize(
    ('arguments', 'complaint'),
    [
        ([], 'error: --output: missing'),
        (['--output=new', 'demonstrator_v1'], 'are not flags'),
    ],
)
def test_a_wrong_command_is_refused_in_one_line(
    tmp_path, monkeypatch, arguments, complaint
):
  monkeypatch.chdir(tmp_path)
  assert complaint in in_process.complaint(make_networks, *arguments)
  assert not list(tmp_path.iterdir())
