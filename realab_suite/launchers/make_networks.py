r"""Trains the networks that feedback providers use, and writes them to files.

  python -m realab_suite.launchers.make_networks --output=results/networks

Each network learns for some minutes from the reading of a secure reward
register, and hence from the true reward. It observes the senses of an agent but
no registers. Its true return is then measured in new episodes, with NumPy. The
same versions on the same kind of machine produce the same files.
"""

import pathlib

from realab_suite import errors
from realab_suite.experiments import requirements
from realab_suite.experiments import threads
from realab_suite.launchers import flags
from realab_suite.launchers import program
from realab_suite.launchers import renderers

flags.take(flags.OUTPUT)


def main() -> None:
  """Trains all networks."""
  output = pathlib.Path(flags.required(flags.OUTPUT))
  if problem := requirements.missing('jax', 'equinox', 'optax', extra='agents'):
    raise errors.SpecError(f'cannot train networks: {problem}')
  threads.use_one()
  renderers.render_on_demand()
  # Imports numerical libraries, so the number of threads has to be set first.
  from realab_suite.experiments import network_training
  from realab_suite.experiments import storage

  paths = {name: output / f'{name}.npz' for name in network_training.RECIPES}
  for path in paths.values():
    if path.exists():
      # Designs refer to networks by name, so files must not change.
      raise errors.SpecError(f'{path} already exists; name another folder')
  # Before the training, which takes minutes.
  with storage.explained(output):
    output.mkdir(parents=True, exist_ok=True)
  for name, recipe in network_training.RECIPES.items():
    network = network_training.make(recipe)
    for reached in network.header.reached:
      program.say(
          f'{name}: true return {reached["mean"]:.2f}'
          f' [{reached["low"]:.2f}, {reached["high"]:.2f}] in'
          f' {reached["task"]}'
      )
    storage.write_whole(paths[name], network.to_bytes())
    program.say(f'{paths[name]} written')


if __name__ == '__main__':
  program.start(main)
