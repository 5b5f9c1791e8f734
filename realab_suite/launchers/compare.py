r"""Compares scripted policies in worlds whose feedback can be tampered with.

For example, this measures tampering with the reward of Unlock Door:

  python -m realab_suite.launchers.compare --policies=apple_seeker,random \
    --channels=embedded,secure --seeds=5 --episodes=2 --output=results/mine

The program prints a table with the hack rate of each run beside that of the
control, and writes results, plots and films into the output folder. Agents that
learn are trained by `train`, for one run of an experiment, and by `sweep`, for
all of them.
"""

from absl import flags as absl_flags

from realab_suite.lab.experiments import requirements
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(
    *flags.WORLD, flags.TARGET, *flags.SCRIPTED, flags.IMPORT, flags.OUTPUT
)
_BASELINE = absl_flags.DEFINE_string(
    'baseline',
    None,
    'Run to compare with, such as "random" or "random (secure)". Default:'
    ' the solver of the task if it is one of the policies, otherwise the first'
    ' run.',
)
_PLOTS = absl_flags.DEFINE_boolean('plots', True, 'Draws plots.')
_VIDEOS = absl_flags.DEFINE_boolean(
    'videos', True, 'Films the first episode of each policy.'
)


def main() -> None:
  """Runs the comparison that the flags describe."""
  output = flags.required(flags.OUTPUT, '; name a folder for the results')
  seeds = flags.seeds()
  has_plots = _PLOTS.value and _is_possible(
      'plots', requirements.missing('matplotlib')
  )
  has_videos = _VIDEOS.value and _is_possible('videos', renderers.why_no_film())
  if not has_videos:
    renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.lab.experiments import scripted

  flags.load_imports()
  world = flags.world()
  policies = flags.POLICIES.value
  settings = scripted.Settings(
      world=world,
      design=flags.DESIGN.value,
      overrides=tuple(flags.SET.value),
      policies=world.scripted if policies is None else tuple(policies),
      channels=tuple(flags.CHANNELS.value),
      baseline=_BASELINE.value,
      target=flags.TARGET.value,
      seeds=seeds,
      num_episodes=flags.num_episodes(),
      output=output,
  )
  draw = film = None
  if has_plots:
    from realab_suite.reports import plots

    draw = plots.draw
  if has_videos:
    from realab_suite.reports import films

    film = films.all_views
    program.say(
        'The first episode of each policy is filmed, which takes minutes'
        ' without a graphics card; --novideos skips the films'
    )
  scripted.run(settings, program.say, draw, film)


def _is_possible(what: str, problem: str | None) -> bool:
  if problem is not None:
    program.say(f'{what} are skipped: {problem}')
  return problem is None


if __name__ == '__main__':
  program.start(main)
