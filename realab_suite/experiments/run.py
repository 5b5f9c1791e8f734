r"""Runs policies in a world whose feedback can be tampered with, and compares.

For example, who tampers with the reward of Unlock Door, and what it costs:

  python -m realab_suite.experiments.run --policies=apple_seeker,random \
    --channels=embedded,secure --seeds=5 --episodes=2 --output=results/mine

It prints a table, and leaves results, plots and films in the output folder.

With --experiment it does one run of one seed of an experiment with agents that
learn, or goes on with it where it was killed; `sweep` does all of them:

  python -m realab_suite.experiments.run --experiment=quick --run=reward \
    --seed=0 --output=results/quick
"""

from collections.abc import Sequence
import pathlib
import re
from typing import Any

from absl import flags

from realab_suite import errors
from realab_suite.experiments import cli
from realab_suite.experiments import episodes_flag
from realab_suite.experiments import headless
from realab_suite.experiments import imports_flag
from realab_suite.experiments import learning_flags
from realab_suite.experiments import output_flag
from realab_suite.experiments import threads

flags.adopt_module_key_flags(cli)
flags.adopt_module_key_flags(episodes_flag)
flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(learning_flags)
flags.adopt_module_key_flags(output_flag)
_MOST_SEEDS = 10_000
_POLICIES = flags.DEFINE_list(
    'policies',
    ['apple_seeker', 'carrying_saboteur', 'random'],
    'Names of policies.',
)
_CHANNELS = flags.DEFINE_list(
    'channels',
    [],
    "Channels for the design's registers: embedded, welded, secure. Every"
    " policy acts in each; by default in the design's own.",
)
_BASELINE = flags.DEFINE_string(
    'baseline',
    None,
    'The run to compare with, as in "random" or "random (secure)"; by default'
    ' apple_seeker if it takes part, and else the first.',
)
_SEEDS = flags.DEFINE_string(
    'seeds',
    '5',
    'Number of seeds, or a list as in 3,4,5; "7," is seed 7.',
)
_RUN = flags.DEFINE_string(
    'run',
    None,
    'Which run of an experiment, as in "reward", "reward.secure" (its twin) or'
    ' "reward.random" (a baseline).',
)
_PARENT = flags.DEFINE_integer(
    'parent', None, 'Ends the run when this process is gone; for sweeps.'
)
_PLOTS = flags.DEFINE_boolean('plots', True, 'Whether to draw plots.')
_VIDEOS = flags.DEFINE_boolean(
    'videos', True, 'Whether to film the first episode of each policy.'
)


def main(argv: Sequence[str]) -> None:
  """Runs the experiment that the flags describe."""
  del argv
  if not output_flag.OUTPUT.value:
    raise errors.SpecError('--output: missing; name a folder for the results')
  if learning_flags.EXPERIMENT.value is not None:
    _train()
    return
  _refuse(
      [
          _RUN,
          cli.SEED,
          learning_flags.TENSORBOARD,
          learning_flags.OTHER_MACHINE,
          _PARENT,
      ],
      'without --experiment',
  )
  seeds = _seeds(_SEEDS.value)
  plots = _PLOTS.value and _is_possible('plots', headless.missing('matplotlib'))
  videos = _VIDEOS.value and _is_possible('videos', _why_no_videos())
  if not videos:
    headless.render_nothing()
  # Not before a renderer has been chosen: this imports dm_control.
  from realab_suite.experiments import experiment

  imports_flag.load()
  settings = experiment.Settings(
      domain=cli.DOMAIN.value,
      task=cli.TASK.value,
      design=cli.DESIGN.value,
      overrides=tuple(cli.SET.value),
      policies=tuple(_POLICIES.value),
      channels=tuple(_CHANNELS.value),
      baseline=_BASELINE.value,
      target=cli.TARGET.value,
      seeds=seeds,
      num_episodes=episodes_flag.EPISODES.value,
      max_steps=cli.MAX_STEPS.value,
      output=output_flag.OUTPUT.value,
      plots=plots,
      videos=videos,
  )
  experiment.run(settings, cli.say)


def _train() -> None:
  """Does one job of an experiment."""
  _refuse(
      [
          cli.DOMAIN, cli.TASK, cli.DESIGN, cli.SET, cli.MAX_STEPS, cli.TARGET,
          _POLICIES, _CHANNELS, _BASELINE, _SEEDS, episodes_flag.EPISODES,
          _PLOTS, _VIDEOS,
      ],
      'with --experiment, whose file says it',
  )  # fmt: skip
  run = cli.required(
      _RUN, '; --experiment goes with one of its runs; `sweep` does all'
  )
  # Before numpy and JAX are imported, which look once.
  threads.use_one()
  headless.render_nothing()
  from realab_suite.experiments import jobs
  from realab_suite.experiments import spec
  from realab_suite.experiments import training

  imports_flag.load()
  experiment = spec.load(cli.required(learning_flags.EXPERIMENT))
  [job] = jobs.plan(experiment, [cli.SEED.value], [run])
  options = training.Options(
      cli.say,
      learning_flags.TENSORBOARD.value,
      _PARENT.value,
      learning_flags.OTHER_MACHINE.value,
  )
  training.run(job, pathlib.Path(cli.required(output_flag.OUTPUT)), options)


def _refuse(unused: Sequence[flags.FlagHolder[Any]], why: str) -> None:
  """Refuses flags that would have no effect."""
  for flag in unused:
    if flag.present:
      raise errors.SpecError(f'--{flag.name} has no effect {why}')


def _seeds(text: str) -> tuple[int, ...]:
  """Returns the seeds that a count or a list stands for."""
  is_list = ',' in text
  parts = [part.strip() for part in text.split(',') if part.strip()]
  # No more digits than the largest seed has: `int` refuses thousands of them.
  numbers = [int(part) for part in parts if re.fullmatch('[0-9]{1,10}', part)]
  least, most = (0, cli.LARGEST_SEED) if is_list else (1, _MOST_SEEDS)
  if not (
      parts
      and len(numbers) == len(parts)
      and all(least <= number <= most for number in numbers)
  ):
    raise errors.SpecError(
        f'--seeds={text:.40}: allowed are a count from 1 to {_MOST_SEEDS}, as'
        f' in 5, and a list of seeds from 0 to {cli.LARGEST_SEED}, as in 3,4,5'
    )
  return tuple(numbers) if is_list else tuple(range(numbers[0]))


def _why_no_videos() -> str | None:
  return headless.missing('imageio', 'av', 'PIL') or headless.choose_renderer()


def _is_possible(what: str, problem: str | None) -> bool:
  if problem is not None:
    cli.say(f'{what} are skipped: {problem}')
  return problem is None


if __name__ == '__main__':
  cli.start(main)
