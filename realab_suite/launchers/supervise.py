r"""Lets a person provide the feedback of an agent, in a browser.

  python -m realab_suite.launchers.supervise --task=near --policy=random \
    --asks=approval --output=results/supervised

The program prints the address of a page, on which the person approves actions,
corrects them, compares two clips, or stops the episode. The output folder gets
the answers (`answers.jsonl`), the design, and the results of the episodes. The
source `recorded` of the provider `person` replays the answers.
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
  from realab_suite import suite
  from realab_suite.evaluation import results
  from realab_suite.experiments import aiming
  from realab_suite.experiments import run_infos
  from realab_suite.experiments import scripted
  from realab_suite.experiments import storage
  from realab_suite.experiments import supervised
  from realab_suite.experiments import supervised_designs
  from realab_suite.feedback import specs
  from realab_suite.interop.browser import servers

  imports_flag.load()
  domain, task = world_flags.world()
  chosen = (
      world_flags.DESIGN.value
      if world_flags.DESIGN.present
      else supervised_designs.design(
          _ASKS.value, 'live', waits=_WAIT.value, every=_EVERY.value
      )
  )
  design = specs.load(chosen, tuple(world_flags.SET.value))
  with contextlib.ExitStack() as stack:
    env = suite.load(
        domain,
        task,
        task_kwargs={
            **world_flags.task_kwargs(),
            'random': seed_flag.SEED.value,
        },
        environment_kwargs={'max_steps': world_flags.MAX_STEPS.value},
        design=design,
    )
    stack.enter_context(contextlib.closing(env))
    policy = aiming.make_policy(
        policy_flag.POLICY.value, env, world_flags.TARGET.value, 0
    )
    host, port = page_flags.HOST.value, page_flags.PORT.value
    server = stack.enter_context(servers.PageServer('supervise', host, port))
    folder = scripted.make_folder(output)
    storage.write_json(folder / 'design.json', design.to_mapping())
    writer = stack.enter_context(results.RowWriter(folder / 'episodes.jsonl'))
    supervision = supervised.Supervision(
        env, server, folder, page_flags.RATE.value
    )
    stack.callback(supervision.close)
    program.say(f'Open this address in a browser: {server.url}')
    lines = []
    for episode in range(page_flags.EPISODES.value):
      result = supervision.run(policy, episode)
      info = run_infos.of(
          env,
          (domain, task),
          policy=policy_flag.POLICY.value,
          run='supervised',
          baseline=None,
      )
      writer.write(results.row(info, result))
      lines.append(
          f'Episode {episode + 1} ended by {result.end.value} after'
          f' {result.num_steps} steps: true return {result.true_return:.2f},'
          f' observed return {result.observed_return:.2f}, corruption'
          f' {result.corruption:.3f} m.'
      )
    lines.append(supervised.delays_text(supervision.delays))
    lines.append(f'The answers are in {folder / supervised.ANSWERS}')
    text = '\n'.join(lines)
    supervision.finish(text)
    program.say(text)


if __name__ == '__main__':
  program.start(main)
