"""Trains the network that ships as a demonstrator, and writes it to a file.

  python examples/train_network.py --output=results/demonstrator.npz

The network learns for some minutes from the reading of a secure reward
register, and hence from the true reward. It observes the senses of an agent but
no registers. Its true return is then measured in new episodes, with NumPy. The
same versions on the same kind of machine produce the same file. This needs the
extra `agents`.
"""

import argparse
from collections.abc import Iterable, Mapping
import contextlib
import dataclasses
import pathlib
from typing import Any

from dm_env import specs as dm_env_specs
import tqdm

from realab_suite import worlds
from realab_suite.config import validation
from realab_suite.entities import appearance
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.feedback import specs
from realab_suite.lab.agents import action_encoding
from realab_suite.lab.agents import base
from realab_suite.lab.agents import features
from realab_suite.lab.agents import network_export
from realab_suite.lab.experiments import jobs
from realab_suite.lab.verdicts import comparison
from realab_suite.lab.verdicts import intervals
from realab_suite.policies import network_files
from realab_suite.policies import network_policies

_DOMAIN, _VARIATION = 'unlock_door', 'near'
_DESIGN = 'instantaneous_reward'
_OVERRIDES = (
    'dof=planar',
    'channel=secure',
    'action_set={name: dmlab_like, version: 1}',
)
# Far from the seeds of experiments, so that their episodes are new.
_SEED = 500_000_000
_EVALUATION_SEED = 600_000_000
_EVALUATION_TASKS = ('near', 'standard', 'far')


DESCRIPTION = (
    'Gathers the small apples, steps on the pad, takes the large apple.'
)
# With a discount of 0.99, the policy leaves five of the eight small apples to
# reach the large one sooner.
LEARNER: Mapping[str, Any] = {
    'kind': 'policy_gradient',
    'reward': 'reward',
    'gamma': 0.998,
    'hidden': [64, 64],
}
STEPS = 2_000_000


def make(
    learner: Mapping[str, Any] = LEARNER,
    steps: int = STEPS,
    num_envs: int = 256,
    num_episodes: int = 200,
) -> network_files.Network:
  """Trains and evaluates a network.

  Args:
    learner: Options of the learner.
    steps: Number of control steps of training, over all worlds.
    num_envs: Number of worlds for training.
    num_episodes: Number of evaluation episodes of each task.
  """
  design = specs.load(_DESIGN, _OVERRIDES)
  network = network_export.export(
      _train(learner, steps, num_envs),
      description=DESCRIPTION,
      made=dict(
          learner=dict(learner),
          task=f'{_DOMAIN}.{_VARIATION}',
          design=_DESIGN,
          overrides=list(_OVERRIDES),
          design_digest=design.digest(),
          num_envs=num_envs,
          steps=steps,
          seed=_SEED,
          versions={**results.versions(), **jobs.versions_of_learners()},
      ),
      reached=(),
  )
  reached = tuple(
      _evaluate(network, task, num_episodes) for task in _EVALUATION_TASKS
  )
  header = network.header.model_copy(update={'reached': reached})
  return dataclasses.replace(network, header=header)


def _train(
    options: Mapping[str, Any], steps: int, num_envs: int
) -> base.Learner:
  """Returns a trained learner."""
  learner_class = base.LEARNERS.get(options['kind'])
  checked = validation.validate(learner_class.OPTIONS, options, 'learner')
  world = worlds.World(_DOMAIN, _VARIATION)
  design = specs.load(_DESIGN, _OVERRIDES)
  with contextlib.closing(
      world.load_batch(design, num_envs, _SEED, sleep=True)
  ) as batch:
    # The output of a supervisor must not depend on the state of registers.
    senses = {
        name: _without_gaps(spec)
        for name, spec in batch.observation_spec().items()
        if name.startswith('senses/')
    }
    encoder = features.Encoder.from_spec(senses)
    learner = learner_class(
        checked,
        f'registers/{getattr(checked, learner_class.READS)}',
        encoder,
        action_encoding.Controls.from_spec(batch.action_spec()),
        num_envs,
        _SEED,
    )
    with tqdm.tqdm(
        total=steps, unit='step', unit_scale=True, disable=None
    ) as bar:
      time_step = batch.reset()
      while learner.num_steps < steps:
        time_step = batch.step(learner.step(time_step))
        bar.update(num_envs)
  return learner


def _without_gaps(spec: dm_env_specs.Array) -> dm_env_specs.Array:
  """Returns a spec whose bounds alone determine its features, as in files."""
  if not isinstance(spec, appearance.ClassArray):
    return spec
  return dm_env_specs.BoundedArray(
      spec.shape, spec.dtype, 0, max(spec.codes), spec.name
  )


def _evaluate(
    network: network_files.Network, variation: str, num_episodes: int
) -> dict[str, Any]:
  """Returns the true return of the policy that takes the best actions."""
  policy = network_policies.NetworkDemonstrator(network)
  design = specs.load(_DESIGN, _OVERRIDES)
  world = worlds.World(_DOMAIN, variation)
  with contextlib.closing(
      world.load_batch(design, num_episodes, _EVALUATION_SEED)
  ) as batch:
    actor = batch_actors.BatchPolicyActor(policy, batch, _EVALUATION_SEED)
    found = evaluate.evaluate_batch(batch, actor)
  return summary(f'{_DOMAIN}.{variation}', found, _EVALUATION_SEED)


def summary(
    task: str, found: Iterable[results.EpisodeResult], seed: int
) -> dict[str, Any]:
  """Returns the mean true return of episodes, for the header of a file."""
  episodes = [episode for episode in found if episode.is_valid]
  interval = intervals.mean_interval(
      {seed: [episode.true_return for episode in episodes]},
      bounds=comparison.return_bounds(episodes),
  )
  return dict(
      task=task,
      mean=interval.estimate,
      low=interval.low,
      high=interval.high,
      level=interval.level,
      episodes=len(episodes),
      seed=seed,
  )


def main() -> None:
  """Trains the network, and writes it."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument('--output', required=True, type=pathlib.Path)
  parser.add_argument('--steps', default=STEPS, type=int)
  arguments = parser.parse_args()
  # Designs refer to networks by name, so files must not change.
  if arguments.output.exists():
    parser.error(f'{arguments.output} already exists; name another file')
  arguments.output.parent.mkdir(parents=True, exist_ok=True)
  network = make(steps=arguments.steps)
  arguments.output.write_bytes(network.to_bytes())
  for reached in network.header.reached:
    print(
        f'true return {reached["mean"]:.2f} [{reached["low"]:.2f},'
        f' {reached["high"]:.2f}] in {reached["task"]}'
    )


if __name__ == '__main__':
  main()
