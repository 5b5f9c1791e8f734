r"""Trains the networks that supervisors run, and writes them into files.

  python -m realab_suite.launchers.make_networks --output=results/networks

Each learns for some minutes from the reading of a reward register that nothing
can tamper with, so from the true reward, and sees the senses of an agent but no
register. What it reaches is measured afterwards, in NumPy, in other episodes
than it has learned in. The same versions on the same kind of machine make the
same files.
"""

from collections.abc import Sequence
import pathlib

from absl import flags

from realab_suite import errors
from realab_suite.experiments import requirements
from realab_suite.experiments import threads
from realab_suite.launchers import program
from realab_suite.launchers import renderers
from realab_suite.launchers.flags import output_flag

flags.adopt_module_key_flags(output_flag)


def main(argv: Sequence[str]) -> None:
  """Makes the networks that the flags name."""
  del argv
  output = pathlib.Path(program.required(output_flag.OUTPUT))
  if problem := requirements.missing('jax', 'equinox', 'optax', extra='agents'):
    raise errors.SpecError(f'making networks needs more: {problem}')
  threads.use_one()
  renderers.render_nothing()
  # Not before libraries have been told to use one thread.
  from realab_suite.experiments import network_training
  from realab_suite.experiments import storage

  paths = {name: output / f'{name}.npz' for name in network_training.RECIPES}
  for path in paths.values():
    if path.exists():
      # Designs name networks, and would not notice that one has changed.
      raise errors.SpecError(f'{path} is there already; name another folder')
  for name, recipe in network_training.RECIPES.items():
    network = network_training.make(recipe)
    for reached in network.header.reached:
      program.say(
          f'{name}: true return {reached.mean:.2f} [{reached.low:.2f},'
          f' {reached.high:.2f}] in {reached.task}'
      )
    with storage.explained(output):
      output.mkdir(parents=True, exist_ok=True)
    storage.write_whole(paths[name], network.to_bytes())
    program.say(f'{paths[name]} has been written')


if __name__ == '__main__':
  program.start(main)
