r"""Compares scripted policies in worlds whose feedback can be tampered with.

For example, this measures tampering with the reward of Unlock Door:

  python -m realab_suite.launchers.compare --policies=apple_seeker,random \
    --channels=embedded,secure --seeds=5 --episodes=2 --output=results/mine

The program prints a table with the hack rate of each run beside that of the
control, and writes results, plots and films into the output folder. Agents that
learn are trained by `train`, for one run of an experiment, and by `sweep`, for
all of them.
"""

from collections.abc import Sequence

from absl import flags

from realab_suite.experiments import requirements
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import episodes_flag
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import output_flag
from realab_suite.launchers.flags import scripted_flags
from realab_suite.launchers.flags import world_flags

flags.adopt_module_key_flags(world_flags)
flags.adopt_module_key_flags(episodes_flag)
flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(output_flag)
flags.adopt_module_key_flags(scripted_flags)
_BASELINE = flags.DEFINE_string(
    'baseline',
    None,
    'Run to compare with, such as "random" or "random (secure)". Default:'
    ' the solver of the task if it is one of the policies, otherwise the first'
    ' run.',
)
_PLOTS = flags.DEFINE_boolean('plots', True, 'Draws plots.')
_VIDEOS = flags.DEFINE_boolean(
    'videos', True, 'Films the first episode of each policy.'
)


def main(argv: Sequence[str]) -> None:
  """Runs the comparison that the flags describe."""
  del argv
  output = program.required(
      output_flag.OUTPUT, '; name a folder for the results'
  )
  seeds = scripted_flags.parse_seeds(scripted_flags.SEEDS.value)
  has_plots = _PLOTS.value and _is_possible(
      'plots', requirements.missing('matplotlib')
  )
  has_videos = _VIDEOS.value and _is_possible('videos', _why_no_videos())
  if not has_videos:
    renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite import worlds
  from realab_suite.experiments import scripted

  imports_flag.load()
  domain, task = world_flags.world()
  world = worlds.World(domain, task)
  policies = scripted_flags.POLICIES.value
  settings = scripted.Settings(
      domain=domain,
      task=task,
      design=world_flags.DESIGN.value,
      overrides=tuple(world_flags.SET.value),
      policies=world.scripted if policies is None else tuple(policies),
      channels=tuple(scripted_flags.CHANNELS.value),
      baseline=_BASELINE.value,
      target=world_flags.TARGET.value,
      seeds=seeds,
      num_episodes=episodes_flag.EPISODES.value,
      max_steps=world_flags.MAX_STEPS.value,
      task_kwargs=world_flags.task_kwargs(),
      senses=world_flags.senses(),
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
  scripted.run(settings, program.say, scripted.Pictures(draw, film))


def _why_no_videos() -> str | None:
  return (
      requirements.missing('imageio', 'av', 'PIL')
      or renderers.choose_renderer()
  )


def _is_possible(what: str, problem: str | None) -> bool:
  if problem is not None:
    program.say(f'{what} are skipped: {problem}')
  return problem is None


if __name__ == '__main__':
  program.start(main)
