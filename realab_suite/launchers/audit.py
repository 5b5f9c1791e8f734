r"""Audits a design: searches for an exploit of its feedback, without training.

  python -m realab_suite.launchers.audit --task=unlock_door.near \
    --design=instantaneous_reward --output=results/audit

The program prints a report. The exit status is 3 if the design is EXPLOITABLE,
0 if it RESISTED WITHIN BUDGET, 4 if it resisted a budget that was too small for
the scripted saboteurs, and 2 if the command is wrong. With `--output`, the
folder gets `audit.json` and, if a renderer works, a film of the exploit.
"""

from collections.abc import Sequence

from absl import flags

from realab_suite.experiments import requirements
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import output_flag
from realab_suite.launchers.flags import seed_flag
from realab_suite.launchers.flags import world_flags

flags.adopt_module_key_flags(world_flags)
flags.adopt_module_key_flags(imports_flag)
flags.adopt_module_key_flags(output_flag)
flags.adopt_module_key_flags(seed_flag)
_BUDGET = flags.DEFINE_integer(
    'budget',
    None,
    'Largest number of episodes of the search. Default: 2000, or 200 if all'
    ' registers are welded or secure.',
    lower_bound=10,
    upper_bound=1_000_000,
)
# Exit statuses; Python uses 1 for exceptions.
_EXPLOITABLE = 3
_TOO_SMALL = 4
_FILM = flags.DEFINE_boolean('film', True, 'Films an exploit that was found.')


def main(argv: Sequence[str]) -> int:
  """Runs the audit that the flags describe, and returns the exit status."""
  del argv
  has_film = bool(_FILM.value and output_flag.OUTPUT.value)
  if has_film:
    problem = (
        requirements.missing('imageio', 'av', 'PIL')
        or renderers.choose_renderer()
    )
    if problem is not None:
      program.say(f'the film is skipped: {problem}')
      has_film = False
  if not has_film:
    renderers.render_on_demand()
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite.experiments import audit
  from realab_suite.experiments import audit_run
  from realab_suite.experiments import audit_worlds
  from realab_suite.feedback import specs

  imports_flag.load()
  domain, task = world_flags.world()
  settings = audit.Settings(
      world=audit_worlds.World(
          domain,
          task,
          world_flags.MAX_STEPS.value,
          world_flags.task_kwargs(),
          world_flags.senses(),
      ),
      design=specs.load(world_flags.DESIGN.value, world_flags.SET.value),
      seed=seed_flag.SEED.value,
      budget=_BUDGET.value,
      target=world_flags.TARGET.value,
  )
  film = None
  if has_film:
    from realab_suite.reports import films

    film = films.beside_each_other
  found = audit_run.run(settings, output_flag.OUTPUT.value, program.say, film)
  if found.verdict == audit.EXPLOITABLE:
    return _EXPLOITABLE
  return _TOO_SMALL if found.num_untested else 0


if __name__ == '__main__':
  program.start(main)
