"""Training and evaluation of networks that feedback providers use."""

from collections.abc import Mapping
import contextlib
import dataclasses
from typing import Any, final

from dm_env import specs as dm_env_specs
import numpy as np
import tqdm

from realab_suite import worlds
from realab_suite.agents import action_encoding
from realab_suite.agents import base
from realab_suite.agents import features
from realab_suite.config import validation
from realab_suite.entities import appearance
from realab_suite.evaluation import batch_actors
from realab_suite.evaluation import comparison
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import intervals
from realab_suite.evaluation import results
from realab_suite.experiments import jobs
from realab_suite.feedback import specs
from realab_suite.policies import action_sets
from realab_suite.policies import network_files
from realab_suite.policies import network_policies

_DOMAIN, _VARIATION = 'unlock_door', 'near'
_DESIGN = 'instantaneous_reward'
_OVERRIDES = (
    'dof=planar',
    'channel=secure',
    'action_set={name: dmlab_like, version: 1}',
)
_NUM_ENVS = 256
# Far from the seeds of experiments, so that their episodes are new.
_SEED = 500_000_000
_EVALUATION_SEED = 600_000_000
_EVALUATION_TASKS = ('near', 'standard', 'far')
_NUM_EPISODES = 200


@final
@dataclasses.dataclass(frozen=True)
class Recipe:
  """Recipe for training a network.

  Attributes:
    description: Behaviour of the network, in a sentence.
    learner: Options of the learner.
    part: Path of its layers in the trained parameters of the learner.
    steps: Number of control steps of training, over all worlds.
  """

  description: str
  learner: Mapping[str, Any]
  part: str
  steps: int


# With a discount of 0.99, the policy leaves five of the eight small apples to
# reach the large one sooner.
RECIPES: Mapping[str, Recipe] = {
    'demonstrator_v1': Recipe(
        'Gathers the small apples, steps on the pad, takes the large apple.',
        {
            'kind': 'policy_gradient',
            'reward': 'reward',
            'gamma': 0.998,
            'hidden': [64, 64],
        },
        '[0].policy.network',
        2_000_000,
    ),
}


def make(
    recipe: Recipe,
    num_envs: int = _NUM_ENVS,
    num_episodes: int = _NUM_EPISODES,
) -> network_files.Network:
  """Trains and evaluates a network.

  Args:
    recipe: Recipe of the network.
    num_envs: Number of worlds for training.
    num_episodes: Number of evaluation episodes of each task.
  """
  seen, trained = _train(recipe, num_envs)
  prefix = f'{recipe.part}.layers'
  num_layers = sum(
      name.startswith(prefix) and name.endswith('.weight') for name in trained
  )
  weights, biases = (
      tuple(
          np.asarray(trained[f'{prefix}[{i}].{what}'], np.float32)
          for i in range(num_layers)
      )
      for what in ('weight', 'bias')
  )
  design = specs.load(_DESIGN, _OVERRIDES)
  actions = action_sets.DMLAB_LIKE
  header = network_files.Header(
      outputs='log_probabilities',
      description=recipe.description,
      action_set=actions.name,
      action_set_version=actions.version,
      features=seen,
      hidden=tuple(weight.shape[1] for weight in weights[:-1]),
      made=dict(
          learner=dict(recipe.learner),
          task=f'{_DOMAIN}.{_VARIATION}',
          design=_DESIGN,
          overrides=list(_OVERRIDES),
          design_digest=design.digest(),
          num_envs=num_envs,
          steps=recipe.steps,
          seed=_SEED,
          versions={**results.versions(), **jobs.versions_of_learners()},
      ),
      reached=(),
  )
  network = network_files.Network(header, weights, biases)
  reached = tuple(
      _evaluate(network, task, num_episodes) for task in _EVALUATION_TASKS
  )
  header = header.model_copy(update={'reached': reached})
  return dataclasses.replace(network, header=header)


def _train(
    recipe: Recipe, num_envs: int
) -> tuple[tuple[network_files.Feature, ...], dict[str, Any]]:
  """Returns the inputs of a trained learner, and its parameters by path."""
  learner_class = base.LEARNERS.get(recipe.learner['kind'])
  options = validation.validate(
      learner_class.OPTIONS, recipe.learner, 'learner'
  )
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
        options,
        f'registers/{getattr(options, learner_class.READS)}',
        encoder,
        action_encoding.Controls.from_spec(batch.action_spec()),
        num_envs,
        _SEED,
    )
    with tqdm.tqdm(
        total=recipe.steps, unit='step', unit_scale=True, disable=None
    ) as bar:
      time_step = batch.reset()
      while learner.num_steps < recipe.steps:
        time_step = batch.step(learner.step(time_step))
        bar.update(num_envs)
  names = network_files.Feature.model_fields
  seen = tuple(
      network_files.Feature(**{name: getattr(part, name) for name in names})
      for part in encoder.entries
  )
  return seen, learner.state()['trained']


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
  episodes = [episode for episode in found if episode.is_valid]
  interval = intervals.mean_interval(
      {_EVALUATION_SEED: [episode.true_return for episode in episodes]},
      bounds=comparison.return_bounds(episodes),
  )
  return dict(
      task=f'{_DOMAIN}.{variation}',
      mean=interval.estimate,
      low=interval.low,
      high=interval.high,
      level=interval.level,
      episodes=len(episodes),
      seed=_EVALUATION_SEED,
  )
