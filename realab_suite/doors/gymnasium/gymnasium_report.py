"""Reports on policies that were trained with Gymnasium.

The policies act in the same episodes as scripted baselines, and the results are
files in the format of a scripted comparison.

An agent is judged on the objective that it was trained for: the return of the
register whose reading was its reward, or else the objective of the learner in
the design.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
import contextlib
from typing import Any, NamedTuple, final

import gymnasium as gym
import pandas as pd

from realab_suite import errors
from realab_suite import policies
from realab_suite import suite
from realab_suite import worlds
from realab_suite.config import integers
from realab_suite.doors.gymnasium import evaluation as gymnasium_evaluation
from realab_suite.doors.gymnasium import single
from realab_suite.engine import environment
from realab_suite.evaluation import evaluate
from realab_suite.feedback import objectives
from realab_suite.feedback import specs
from realab_suite.lab.audit import aiming
from realab_suite.lab.experiments import evaluations
from realab_suite.lab.experiments import storage
from realab_suite.lab.verdicts import stakes

FIRST_SEED = 10_000
"""First seed of the evaluation episodes by default."""

_Wrap = Callable[[gym.Env], gym.Env]


@final
class Report(NamedTuple):
  """A report.

  Attributes:
    judged: A line for each run, the control first, and for each of its seeds;
      see `study.judge`.
    text: Contents of `summary.md`.
  """

  judged: pd.DataFrame
  text: str


def write(
    name: str,
    agents: Mapping[str, Sequence[gymnasium_evaluation.Policy]],
    output: str,
    *,
    num_episodes: int = 20,
    first_seed: int = FIRST_SEED,
    wrap: _Wrap = lambda env: env,
    baselines: Sequence[str] | None = None,
    **options: Any,
) -> Report:
  """Evaluates agents beside scripted baselines, and writes a report.

  The folder gets `summary.md`, `summary.csv`, one row per episode in
  `episodes.jsonl`, the design, and `run.json` with everything else that is
  needed to repeat the evaluation except the policies. No label is favourable,
  because the training was not recorded.

  Args:
    name: Id of a world, such as
      `'realab/UnlockDoor-near-InstantaneousReward-v3'`.
    agents: Policies by the name of the agent: one for each seed of training,
      equally many for each agent. Policy i acts in the episodes of seed
      `first_seed + i`. A verdict needs five.
    output: New folder for the results.
    num_episodes: Number of episodes per seed.
    first_seed: First seed of the episodes.
    wrap: Function that adds the wrappers of training to a world.
    baselines: Names of scripted policies; `'solver'` stands for the solver of
      the task. The solver is the control, in any position, or else the first.
      `None` for the solver, if there is one, and random actions.
    **options: Keyword arguments of `gymnasium.make`, such as `overrides`. The
      agents are judged on the return of `reward_register`, if it is given, and
      otherwise on the objective of the design's learner.

  Raises:
    ResultsError: If the folder is not empty or cannot be created.
    SpecError: If an argument is invalid. Nothing has been written.
  """
  integers.check('num_episodes', num_episodes, 1)
  integers.check('first_seed', first_seed, 0)
  num_seeds = _num_seeds(agents)
  settings = _settings(name, options)
  with _opened(name, settings, first_seed, wrap) as env:
    env.reset()  # Refuses wrappers with a seed.
    loaded = single.environment_of(env)
    world, design = _world_of(loaded, settings), loaded.mechanism.design
    baseline_names = _baselines(baselines, world, agents)
    for run in baseline_names:
      aiming.make_policy(run, loaded, None, 0)
  judged = _judged_design(design, settings.get('reward_register'))
  objective = judged.objective
  with evaluations.Evaluation(
      world,
      judged,
      storage.new_folder(output),
      lambda line: None,
      control=baseline_names[0],
  ) as evaluation:
    evaluation.measure()
    evaluation.describe(
        {'design': design},
        id=name,
        objective=objective and objective.to_mapping(),
        settings={k: v for k, v in settings.items() if k != 'design'},
        overrides=list(settings.get('overrides') or ()),
        agents={agent: len(of) for agent, of in agents.items()},
        baselines=list(baseline_names),
        seeds=[first_seed + i for i in range(num_seeds)],
        num_episodes=num_episodes,
    )
    for i in range(num_seeds):
      with _opened(name, settings, first_seed + i, wrap) as env:
        loaded = single.environment_of(env)
        for run in baseline_names:
          info = evaluation.info(loaded, run, run)
          for episode in range(num_episodes):
            policy = aiming.make_policy(run, loaded, None, episode)
            [result] = evaluate.evaluate(
                loaded, policy, 1, first_episode=episode, objective=objective
            )
            evaluation.add(info, result)
        for run, of_seeds in agents.items():
          info = evaluation.info(loaded, run, run)
          for result in gymnasium_evaluation.evaluate(
              env,
              of_seeds[i],
              num_episodes,
              objective=objective,
              is_hacked=evaluation.counts,
          ):
            evaluation.add(info, result)
    title = (
        f'# {name}\n\nSeeds: {num_seeds}; episodes per seed: {num_episodes};'
        ' means with 95 % intervals.'
    )
    judged, text = evaluation.summarize(title, agents)
  return Report(judged, f'{title}\n\n{text}')


def _settings(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
  """Returns all arguments with which a world is loaded.

  Raises:
    SpecError: If it is the id of another package.
  """
  settings = {**gym.spec(name).kwargs, **options}
  if 'domain_name' not in settings:
    raise errors.SpecError(
        f'name: {name!r}; must be an id of realab_suite.doors.gymnasium'
    )
  return settings


@contextlib.contextmanager
def _opened(
    name: str, settings: Mapping[str, Any], seed: int, wrap: _Wrap
) -> Iterator[gym.Env]:
  """Loads a world with a seed, wrapped for agents, and closes it."""
  task_kwargs = {**(settings.get('task_kwargs') or {}), 'random': seed}
  env = gym.make(name, **{**settings, 'task_kwargs': task_kwargs})
  # For good, because agents may keep the world, and other seeds follow.
  single.forget_seed(env)
  with contextlib.closing(env), single.keeping_seed(env):
    yield wrap(env)


def _world_of(
    loaded: environment.Environment, settings: Mapping[str, Any]
) -> worlds.World:
  """Returns the world of the episodes."""
  kwargs = dict(settings.get('task_kwargs') or {})
  kwargs.pop('random', None)
  senses = (settings.get('environment_kwargs') or {}).get('senses')
  return worlds.World(
      str(settings['domain_name']),
      str(settings['task_name']),
      loaded.max_steps or suite.MAX_STEPS,
      kwargs,
      None if senses is None else tuple(senses),
  )


def _judged_design(
    design: specs.DesignSpec, register: str | None
) -> specs.DesignSpec:
  """Returns a design whose learner has the objective of a trained agent.

  Args:
    design: Design of the world.
    register: Register whose reading was the reward, or `None`.
  """
  if register is None:
    return design
  objective = {'kind': objectives.RETURN, 'registers': {register: 1.0}}
  learner = {'kind': 'gymnasium', 'objective': objective}
  return specs.load({**design.to_source(), 'learner': learner})


def _num_seeds(
    agents: Mapping[str, Sequence[gymnasium_evaluation.Policy]],
) -> int:
  """Returns the number of policies of each agent.

  Raises:
    SpecError: If there is none, or agents have different numbers of them.
  """
  numbers = {name: len(of_seeds) for name, of_seeds in agents.items()}
  if 0 in numbers.values() or len(set(numbers.values())) != 1:
    raise errors.SpecError(
        f'agents: {numbers} policies; must be equal numbers of at least'
        ' one, because agents are compared in the same episodes'
    )
  return next(iter(numbers.values()))


def _baselines(
    names: Sequence[str] | None, world: worlds.World, agents: Collection[str]
) -> tuple[str, ...]:
  """Returns the names of the baselines, the control first.

  Args:
    names: Names that the caller gave, or `None`.
    world: World of the episodes.
    agents: Names of the agents.

  Raises:
    SpecError: If they are not valid, or an agent has the name of one.
  """
  if names is None:
    names = [*([world.solver] if world.solver else []), stakes.RANDOM]
  if policies.base.SOLVER in names and world.solver is None:
    raise errors.SpecError(
        'baselines: solver: the task names no solver; name other policies'
    )
  names = [aiming.in_world(name, world.solver) for name in names]
  if not names or len({*names}) != len(names):
    raise errors.SpecError(
        f'baselines: {names}; must be at least one policy, each of them once'
    )
  # Tables do not judge runs with the names of controls.
  for name in (*names, stakes.RANDOM, stakes.AT_REST):
    if name in agents:
      raise errors.SpecError(
          f'agents: {name!r} is the name of a baseline; choose another name'
      )
  control = world.control_of(names)
  return (control, *(name for name in names if name != control))
