"""Trains the agents that ship, and writes their files.

  python examples/train_policies.py --output=results/policies

They are runs of the experiment `policies` with one seed: some minutes on one
processor. The folder becomes that of the experiment, so that the same command
continues, and leaves out what has finished. The same versions on the same kind
of machine produce the same files. This needs the extra `agents`.
"""

import argparse
import contextlib
import pathlib
import subprocess
import sys

import train_network

from realab_suite.evaluation import results
from realab_suite.lab.agents import network_export
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import training
from realab_suite.policies import network_files

EXPERIMENT = 'policies'
# Of the three seeds of the tamperer, the one whose mean gain was the median.
SEED = 0
# Run of each agent, and what it does.
AGENTS = {
    'tamperer': ('tamperer', 'Moves a block, and is paid more than it earns.'),
    'twin': ('tamperer.secure', 'Gathers apples, and takes the large one.'),
    'imitator': ('imitator', 'Gathers apples, as the script that it imitates.'),
}


def make(folder: pathlib.Path, name: str) -> network_files.Network:
  """Returns the network of an agent that was trained in a folder."""
  run, description = AGENTS[name]
  experiment = experiment_specs.load(EXPERIMENT)
  [job] = jobs.plan(experiment, [SEED], [run])
  path = folder / job.folder()
  config = jobs.read_config(path)
  rows = results.read_rows(path / training.EPISODES)
  with contextlib.closing(
      job.experiment.world.load_batch(job.design, 1, SEED)
  ) as batch:
    learner = training.load_learner(job, path, batch)
  is_twin = job.twin_of is not None
  return network_export.export(
      learner,
      description=description,
      made=dict(
          learner=config['design']['learner'],
          task=config['task'],
          design=job.spec.design,
          overrides=[*job.spec.overrides, *['channel=secure'] * is_twin],
          design_digest=job.design.digest(),
          training=config['training'],
          actions=config['evaluation']['actions'],
          seed=SEED,
          versions=config['versions'],
      ),
      reached=(
          train_network.summary(config['task'], rows, job.evaluation_seed),
      ),
  )


def main() -> None:
  """Trains the agents, and writes them beside their results."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument('--output', required=True, type=pathlib.Path)
  folder = parser.parse_args().output
  for name, (run, _) in AGENTS.items():
    # Threads are limited before numerical libraries are imported.
    flags = {
        'experiment': EXPERIMENT,
        'run': run,
        'seed': SEED,
        'output': folder,
    }
    subprocess.run(
        [
            *(sys.executable, '-m', 'realab_suite.launchers.train'),
            *(f'--{flag}={value}' for flag, value in flags.items()),
        ],
        check=True,
    )
    (folder / f'{name}.npz').write_bytes(make(folder, name).to_bytes())


if __name__ == '__main__':
  main()
