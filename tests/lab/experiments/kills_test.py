"""A sweep that is killed at random moments gives the results of any other."""

from campaigns import figure_lines
from campaigns import kills_campaign
from tests.lab.experiments import small

# The launcher, on a learner that starts fast.
_PROGRAM = (
    'from realab_suite.lab.experiments import scheduler\n'
    'from realab_suite.launchers import program, sweep\n'
    "scheduler._MODULE = 'tests.lab.experiments.fake_learner'\n"
    'program.start(sweep.main)\n'
)
_EXPERIMENT = {
    **small.EXPERIMENT,
    'max_steps': 20,
    'baselines': [],
    'seeds': [0],
    'training': {
        'num_envs': 2,
        'steps': 1_000,
        'checkpoint_every': 100,
        'curve_every': 100,
    },
}


def test_a_sweep_that_is_killed_ends_like_any_other(monkeypatch, capsys):
  monkeypatch.setattr(kills_campaign, '_COMMAND', ('-c', _PROGRAM))
  lines = figure_lines.Lines('local', 0)
  kills_campaign.run(_EXPERIMENT, 'local', 2, lines, 0)
  assert lines.num_missed == 0, capsys.readouterr().out
