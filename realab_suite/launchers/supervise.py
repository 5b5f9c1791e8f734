r"""Lets a person provide the feedback of an agent, in a browser.

  python -m realab_suite.launchers.supervise --task=near --policy=random \
    --asks=approval --output=results/supervised

The program prints the address of a page, on which the person approves actions,
corrects them, compares two clips, or stops the episode. The output folder gets
the answers (`answers.jsonl`), the design, and the results of the episodes. The
source `recorded` of the provider `person` replays the answers. The agent is not
judged: a person would have to answer again for a control.
"""

from collections.abc import Sequence
import contextlib

from absl import flags

from realab_suite import errors
from realab_suite.experiments import requirements
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import imports_flag
from realab_suite.launchers.flags import output_flag
from realab_suite.launchers.flags import page_flags
from realab_suite.launchers.flags import policy_flag
from realab_suite.launchers.flags import seed_flag
from realab_suite.launchers.flags import world_flags

for module in (
    imports_flag,
    output_flag,
    page_flags,
    policy_flag,
    seed_flag,
    world_flags,
):
  flags.adopt_module_key_flags(module)
_ASKS = flags.DEFINE_enum(
    'asks',
    'approval',
    ['approval', 'correction', 'comparison'],
    'Question to the person, unless --design names a design with a person.',
)
_WAIT = flags.DEFINE_boolean(
    'wait',
    False,
    'Waits for every answer. Otherwise the episode continues without, and the'
    ' provider is silent.',
)
_EVERY = flags.DEFINE_integer(
    'every', 1, 'Control steps between two questions.', 1
)


def main(argv: Sequence[str]) -> None:
  """Serves the page, and writes the answers."""
  del argv
  output = program.required(
      output_flag.OUTPUT, '; name a folder for the answers'
  )
  problem = (
      requirements.missing('websockets', 'PIL', extra='browser')
      or renderers.choose_renderer()
  )
  if problem is not None:
    raise errors.ResultsError(f'cannot show the world: {problem}')
  # Imports dm_control, so a renderer has to be chosen first.
  from realab_suite import worlds
  from realab_suite.audit import aiming
  from realab_suite.experiments import scripted
  from realab_suite.experiments import storage
  from realab_suite.experiments import supervised
  from realab_suite.experiments import supervised_designs
  from realab_suite.feedback import specs
  from realab_suite.interop.browser import servers

  imports_flag.load()
  world = worlds.World(
      *world_flags.world(),
      world_flags.MAX_STEPS.value,
      world_flags.task_kwargs(),
  )
  chosen = (
      world_flags.DESIGN.value
      if world_flags.DESIGN.present
      else supervised_designs.design(
          _ASKS.value,
          'live',
          waits=_WAIT.value,
          every=_EVERY.value,
          action_set=world.action_set,
      )
  )
  design = specs.load(chosen, tuple(world_flags.SET.value))
  with contextlib.ExitStack() as stack:
    env = world.load(design, seed_flag.SEED.value)
    stack.enter_context(contextlib.closing(env))
    name = policy_flag.POLICY.value
    policy = aiming.make_policy(name, env, world_flags.TARGET.value, 0)
    host, port = page_flags.HOST.value, page_flags.PORT.value
    server = stack.enter_context(servers.PageServer('supervise', host, port))
    folder = scripted.make_folder(output)
    storage.write_json(folder / 'design.json', design.to_mapping())
    supervision = supervised.Supervision(
        env, server, folder, page_flags.RATE.value
    )
    stack.callback(supervision.close)
    program.say(f'Open this address in a browser: {server.url}')
    program.say(
        supervised.run(
            supervision,
            (world.domain, world.task),
            name,
            policy,
            page_flags.EPISODES.value,
        )
    )


if __name__ == '__main__':
  program.start(main)
