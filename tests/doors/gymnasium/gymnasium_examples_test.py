"""Examples of training with PyTorch, where it is installed."""

import pathlib
import runpy

import pytest

pytest.importorskip('gymnasium')
pytest.importorskip('torch')

_EXAMPLES = pathlib.Path(__file__).parents[3] / 'examples'


def test_the_script_in_the_style_of_cleanrl_trains_and_evaluates(capsys):
  script = runpy.run_path(str(_EXAMPLES / 'train_cleanrl_style.py'))
  script['main'](['--steps=256', '--num_envs=2', '--episodes=1'])
  training, heading, episode, mean = capsys.readouterr().out.splitlines()
  assert training.startswith('step 256: observed return')
  assert 'true return' in heading
  assert episode.split()[1:] == mean.split()[1:]
