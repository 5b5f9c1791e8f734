"""Reports on policies that were trained with Gymnasium.

The policies act in the same episodes as scripted baselines, and the results are
files in the format of a scripted comparison.

An agent is judged on the objective that it was trained for: the return of the
register whose reading was its reward, or else the objective of the learner in
the design.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
import contextlib
import importlib
import pathlib
from typing import Any, NamedTuple, final

import gymnasium as gym
import yaml

from realab_suite import errors
from realab_suite import suite
from realab_suite import worlds
from realab_suite.audit import aiming
from realab_suite.config import integers
from realab_suite.config import messages
from realab_suite.engine import environment
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import gains
from realab_suite.evaluation import results
from realab_suite.evaluation import stakes
from realab_suite.evaluation import verdicts
from realab_suite.experiments import machines
from realab_suite.experiments import result_tables
from realab_suite.experiments import run_infos
from realab_suite.experiments import scripted
from realab_suite.experiments import storage
from realab_suite.feedback import objectives
from realab_suite.feedback import specs
from realab_suite.interop.gymnasium import evaluation
from realab_suite.interop.gymnasium import single

FIRST_SEED = 10_000
"""First seed of the evaluation episodes by default."""

_Wrap = Callable[[gym.Env], gym.Env]


@final
class Report(NamedTuple):
  """A report.

  Attributes:
    lines: Summary of each run, the control first.
    labels: Label of each seed, by the name of the agent.
    text: Contents of `summary.md`.
  """

  lines: list[result_tables.Line]
  labels: dict[str, Mapping[int, verdicts.Judgement]]
  text: str


def write(
    name: str,
    agents: Mapping[str, Sequence[evaluation.Policy]],
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
    baselines: Names of scripted policies. The first one is the control. `None`
      for the solver of the task, if it has one, and random actions.
    **options: Keyword arguments of `gymnasium.make`, such as `overrides`. The
      agents are judged on the return of `reward_register`, if it is given, and
      otherwise on the objective of the design's learner.

  Raises:
    ResultsError: If the folder is not empty or cannot be created.
    SpecError: If an argument is invalid. Nothing has been written.
  """
  job = _Job(name, agents, num_episodes, first_seed, wrap, baselines, options)
  folder = scripted.make_folder(output)
  stake = job.measure()
  job.describe(folder)
  with results.RowWriter(folder / 'episodes.jsonl') as writer:
    lines = job.run(writer, stake)
  text = '\n\n'.join(
      [
          f'# {name}',
          f'Seeds: {job.num_seeds}; episodes per seed: {num_episodes}; means'
          ' with 95 % intervals.',
          result_tables.as_text(lines),
      ]
  )
  storage.write_whole(folder / 'summary.md', f'{text}\n'.encode())
  with storage.explained(folder):
    result_tables.write_csv(lines, folder / 'summary.csv')
  of_agents = {line.run: line.labels for line in lines if line.run in agents}
  return Report(lines, of_agents, text)


@final
class _Job:
  """Execution of an evaluation."""

  def __init__(
      self,
      name: str,
      agents: Mapping[str, Sequence[evaluation.Policy]],
      num_episodes: int,
      first_seed: int,
      wrap: _Wrap,
      baselines: Sequence[str] | None,
      options: Mapping[str, Any],
  ) -> None:
    self._name = name
    self._agents = agents
    self._num_episodes = integers.check('num_episodes', num_episodes, 1)
    self._first_seed = integers.check('first_seed', first_seed, 0)
    self._wrap = wrap
    self._options = dict(options)
    self.num_seeds = _num_seeds(agents)
    self._settings = {**_spec(name).kwargs, **self._options}
    if 'domain_name' not in self._settings:
      raise errors.SpecError(
          f'name: {name!r}; allowed are ids of realab_suite.interop.gymnasium'
      )
    with self._open(first_seed) as env:
      loaded = single.environment_of(env)
      self._design = loaded.mechanism.design
      self._world = self._world_of(loaded)
      self._baselines = _baselines(baselines, self._world.solver, agents)
      for policy in self._baselines:
        aiming.make_policy(policy, loaded, None, 0)
    self._judged = _judged_design(
        self._design, self._settings.get('reward_register')
    )

  def _world_of(self, loaded: environment.Environment) -> worlds.World:
    """Returns the world of the episodes."""
    kwargs = dict(self._settings.get('task_kwargs') or {})
    kwargs.pop('random', None)
    senses = (self._settings.get('environment_kwargs') or {}).get('senses')
    return worlds.World(
        str(self._settings['domain_name']),
        str(self._settings['task_name']),
        loaded.max_steps or suite.MAX_STEPS,
        kwargs,
        None if senses is None else tuple(senses),
    )

  @contextlib.contextmanager
  def _open(self, seed: int) -> Iterator[gym.Env]:
    """Loads the world with a seed, wrapped for agents, and closes it."""
    task_kwargs = {**(self._options.get('task_kwargs') or {}), 'random': seed}
    options = {**self._options, 'task_kwargs': task_kwargs}
    with contextlib.closing(gym.make(self._name, **options)) as env:
      yield self._wrap(env)

  def describe(self, folder: pathlib.Path) -> None:
    """Writes the files that are needed to repeat the evaluation."""
    text = yaml.safe_dump(self._design.to_mapping(), sort_keys=False)
    storage.write_whole(folder / 'design.yaml', text.encode())
    version, digest = suite.dynamics(self._world.domain, self._world.task)
    settings = {k: v for k, v in self._settings.items() if k != 'design'}
    objective = self._judged.objective
    description = {
        'id': self._name,
        'objective': objective and objective.to_mapping(),
        'settings': settings,
        'agents': {name: len(of) for name, of in self._agents.items()},
        'baselines': list(self._baselines),
        'num_episodes': self._num_episodes,
        'first_seed': self._first_seed,
        'dynamics': {'version': version, 'digest': digest},
        'versions': results.versions(),
        'machine': machines.here(),
    }
    storage.write_json(folder / 'run.json', description)

  def measure(self) -> stakes.Stakes | None:
    """Returns the stakes of the objective that agents are judged on."""
    return worlds.stakes_of(self._world, self._judged)

  def run(
      self, writer: results.RowWriter, stake: stakes.Stakes | None
  ) -> list[result_tables.Line]:
    """Runs all episodes, writes their rows, and returns the summaries.

    Args:
      writer: Writer of the rows.
      stake: Result of `measure`.
    """
    rows: dict[str, list[results.EpisodeRow]] = {}
    control = self._baselines[0]
    for i in range(self.num_seeds):
      with self._open(self._first_seed + i) as env:
        loaded = single.environment_of(env)
        for run, found in self._results(env, loaded, i):
          info = run_infos.of(
              loaded,
              (self._world.domain, self._world.task),
              policy=run,
              run=run,
              baseline=None if run == control else control,
          )
          row = results.row(info, found, stake)
          writer.write(row)
          rows.setdefault(run, []).append(row)
    return result_tables.summarize(
        rows,
        control,
        gains.consumed(self._judged),
        stake,
        worlds.why_no_stakes(self._world, self._judged),
        self._agents,
        worlds.obstacles_of(self._world, self._judged, stake),
    )

  def _results(
      self, env: gym.Env, loaded: environment.Environment, i: int
  ) -> Iterator[tuple[str, evaluate.EpisodeResult]]:
    """Yields the name of a run and the result of an episode, for one seed."""
    for name in self._baselines:
      for episode in range(self._num_episodes):
        policy = aiming.make_policy(name, loaded, None, episode)
        [found] = evaluate.evaluate(
            loaded,
            policy,
            1,
            first_episode=episode,
            objective=self._judged.objective,
        )
        yield name, found
    for name, policies in self._agents.items():
      for found in evaluation.evaluate(
          env,
          policies[i],
          self._num_episodes,
          objective=self._judged.objective,
      ):
        yield name, found


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
  return specs.load({**design.to_mapping(), 'learner': learner})


def _spec(name: str) -> Any:
  """Returns the registered spec of an id, which may begin with its module."""
  module, _, registered = name.rpartition(':')
  if module:
    importlib.import_module(module)
  return gym.spec(registered)


def _num_seeds(agents: Mapping[str, Sequence[evaluation.Policy]]) -> int:
  """Returns the number of policies of each agent.

  Raises:
    SpecError: If there is no agent, or if one has no policies or another number
      of them.
  """
  if not agents:
    raise errors.SpecError('agents: {}; at least one is needed')
  for name, policies in agents.items():
    is_sequence = isinstance(policies, Sequence) and len(policies) > 0
    if not is_sequence or not all(callable(one) for one in policies):
      raise errors.SpecError(
          f'agents: {name}: {messages.quote(policies)}; allowed is a list of'
          ' functions from an observation to an action'
      )
  numbers = {name: len(policies) for name, policies in agents.items()}
  if len(set(numbers.values())) > 1:
    raise errors.SpecError(
        f'agents: {numbers} policies; allowed are equal numbers, because agents'
        ' are compared in the same episodes'
    )
  return next(iter(numbers.values()))


def _baselines(
    given: Sequence[str] | None, solver: str | None, agents: Collection[str]
) -> tuple[str, ...]:
  """Returns the names of the baselines, the control first.

  Args:
    given: Names that the caller gave, or `None`.
    solver: Name of the policy that solves the task, or `None`.
    agents: Names of the agents.

  Raises:
    SpecError: If there is none, or an agent has the name of a baseline.
  """
  if given is None:
    given = [stakes.RANDOM] if solver is None else [solver, stakes.RANDOM]
  if not given:
    raise errors.SpecError('baselines: []; at least one is needed')
  # Tables do not judge runs with the names of controls.
  for name in (*given, stakes.RANDOM, stakes.AT_REST):
    if name in agents:
      raise errors.SpecError(
          f'agents: {name!r} is the name of a baseline; allowed are others'
      )
  return tuple(given)
