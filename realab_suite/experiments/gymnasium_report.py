"""Reports on policies that were trained with Gymnasium.

The policies act in the same episodes as scripted baselines, and the results are
files in the format of a scripted comparison.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import importlib
import pathlib
from typing import Any, NamedTuple, final

import gymnasium as gym
import yaml

from realab_suite import errors
from realab_suite import suite
from realab_suite.config import messages
from realab_suite.engine import environment
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import gains
from realab_suite.evaluation import labels
from realab_suite.evaluation import results
from realab_suite.experiments import aiming
from realab_suite.experiments import machines
from realab_suite.experiments import result_tables
from realab_suite.experiments import run_infos
from realab_suite.experiments import scripted
from realab_suite.experiments import storage
from realab_suite.interop.gymnasium import evaluation
from realab_suite.interop.gymnasium import single

FIRST_SEED = 10_000
"""First seed of the evaluation episodes by default."""

_Wrap = Callable[[gym.Env], gym.Env]


@final
class Report(NamedTuple):
  """A report.

  Attributes:
    lines: Summary of each run, the baseline first.
    labels: Label of each seed, by the name of the agent.
    text: Contents of `summary.md`.
  """

  lines: list[result_tables.Line]
  labels: dict[str, dict[int, labels.Label]]
  text: str


def write(
    name: str,
    agents: Mapping[str, Sequence[evaluation.Policy]],
    output: str,
    *,
    num_episodes: int = 20,
    first_seed: int = FIRST_SEED,
    wrap: _Wrap = lambda env: env,
    baselines: Sequence[str] = ('apple_seeker', 'random'),
    **options: Any,
) -> Report:
  """Evaluates agents beside scripted baselines, and writes a report.

  The folder gets `summary.md`, `summary.csv`, one row per episode in
  `episodes.jsonl`, the design, and `run.json` with everything else that is
  needed to repeat the evaluation except the policies.

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
    baselines: Names of scripted policies. The first one is the baseline.
    **options: Keyword arguments of `gymnasium.make`, such as `overrides`.

  Raises:
    ResultsError: If the folder is not empty or cannot be created.
    SpecError: If an argument is invalid. Nothing has been written.
  """
  job = _Job(name, agents, num_episodes, first_seed, wrap, baselines, options)
  folder = scripted.make_folder(output)
  job.describe(folder)
  with results.RowWriter(folder / 'episodes.jsonl') as writer:
    rows = job.run(writer)
  lines = result_tables.summarize(rows, baselines[0], gains.scales(job.design))
  by_agent = {line.run: _labels(line) for line in lines if line.run in agents}
  text = '\n\n'.join(
      [
          f'# {name}',
          f'Seeds: {job.num_seeds}; episodes per seed: {num_episodes}; means'
          ' with 95 % intervals.',
          result_tables.as_text(lines),
          result_tables.readings(lines),
          _labels_text(by_agent),
      ]
  )
  storage.write_whole(folder / 'summary.md', f'{text}\n'.encode())
  with storage.explained(folder):
    result_tables.write_csv(lines, folder / 'summary.csv')
  return Report(lines, by_agent, text)


def _labels(line: result_tables.Line) -> dict[int, labels.Label]:
  """Returns `TAMPERS` or `NONE` for each seed.

  The training was not recorded, so it is unknown whether an agent that does not
  tamper ever found out.
  """
  by_seed = {} if line.hacking is None else line.hacking.by_seed
  found = {seed: labels.label(one, 0, None) for seed, one in by_seed.items()}
  is_tampering = labels.Label.TAMPERS
  return {
      seed: one if one is is_tampering else labels.Label.NONE
      for seed, one in found.items()
  }


def _labels_text(by_agent: Mapping[str, Mapping[int, labels.Label]]) -> str:
  lines = [
      f'* {agent}: seed {seed}: {one.value}'
      for agent, by_seed in by_agent.items()
      for seed, one in by_seed.items()
  ]
  note = (
      'Labels of single seeds. "n/a": no tampering was seen, and it is unknown'
      ' whether the agent ever met it, because its training was not recorded.'
  )
  if not lines:
    note = (
        'Seeds have no labels, because no register has a direction that pays.'
    )
  return '\n'.join([note, *([''] if lines else []), *lines])


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
      baselines: Sequence[str],
      options: Mapping[str, Any],
  ) -> None:
    self._name = name
    self._agents = agents
    self._num_episodes = num_episodes
    self._first_seed = first_seed
    self._wrap = wrap
    self._baselines = tuple(baselines)
    self._options = dict(options)
    self.num_seeds = _num_seeds(agents, self._baselines)
    if not isinstance(num_episodes, int) or num_episodes < 1:
      raise errors.SpecError(
          f'num_episodes: {messages.quote(num_episodes)}; allowed are positive'
          ' integers'
      )
    self._settings = {**_spec(name).kwargs, **self._options}
    if 'domain_name' not in self._settings:
      raise errors.SpecError(
          f'name: {name!r}; allowed are ids of realab_suite.interop.gymnasium'
      )
    self._world = (
        str(self._settings['domain_name']),
        str(self._settings['task_name']),
    )
    with self._open(first_seed) as env:
      loaded = single.environment_of(env)
      self.design = loaded.mechanism.design
      for policy in self._baselines:
        aiming.make_policy(policy, loaded, None, 0)

  @contextlib.contextmanager
  def _open(self, seed: int) -> Iterator[gym.Env]:
    """Loads the world with a seed, wrapped for agents, and closes it."""
    task_kwargs = {**(self._options.get('task_kwargs') or {}), 'random': seed}
    options = {**self._options, 'task_kwargs': task_kwargs}
    with contextlib.closing(gym.make(self._name, **options)) as env:
      yield self._wrap(env)

  def describe(self, folder: pathlib.Path) -> None:
    """Writes the files that are needed to repeat the evaluation."""
    text = yaml.safe_dump(self.design.to_mapping(), sort_keys=False)
    storage.write_whole(folder / 'design.yaml', text.encode())
    version, digest = suite.dynamics(*self._world)
    settings = {k: v for k, v in self._settings.items() if k != 'design'}
    description = {
        'id': self._name,
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

  def run(
      self, writer: results.RowWriter
  ) -> dict[str, list[results.EpisodeRow]]:
    """Runs all episodes, and returns the rows of each run."""
    rows: dict[str, list[results.EpisodeRow]] = {}
    baseline = self._baselines[0]
    for i in range(self.num_seeds):
      with self._open(self._first_seed + i) as env:
        loaded = single.environment_of(env)
        for run, found in self._results(env, loaded, i):
          info = run_infos.of(
              loaded,
              self._world,
              policy=run,
              run=run,
              baseline=None if run == baseline else baseline,
          )
          row = results.row(info, found)
          writer.write(row)
          rows.setdefault(run, []).append(row)
    return rows

  def _results(
      self, env: gym.Env, loaded: environment.Environment, i: int
  ) -> Iterator[tuple[str, evaluate.EpisodeResult]]:
    """Yields the name of a run and the result of an episode, for one seed."""
    for name in self._baselines:
      for episode in range(self._num_episodes):
        policy = aiming.make_policy(name, loaded, None, episode)
        [found] = evaluate.evaluate(loaded, policy, 1, first_episode=episode)
        yield name, found
    for name, policies in self._agents.items():
      for found in evaluation.evaluate(env, policies[i], self._num_episodes):
        yield name, found


def _spec(name: str) -> Any:
  """Returns the registered spec of an id, which may begin with its module."""
  module, _, registered = name.rpartition(':')
  if module:
    importlib.import_module(module)
  return gym.spec(registered)


def _num_seeds(
    agents: Mapping[str, Sequence[evaluation.Policy]],
    baselines: Sequence[str],
) -> int:
  """Returns the number of policies of each agent.

  Raises:
    SpecError: If there is no agent or no baseline, if an agent has no policies
      or another number of them, or if it has the name of a baseline.
  """
  if not baselines:
    raise errors.SpecError('baselines: []; at least one is needed')
  if not agents:
    raise errors.SpecError('agents: {}; at least one is needed')
  for name, policies in agents.items():
    is_sequence = isinstance(policies, Sequence) and len(policies) > 0
    if not is_sequence or not all(callable(one) for one in policies):
      raise errors.SpecError(
          f'agents: {name}: {messages.quote(policies)}; allowed is a list of'
          ' functions from an observation to an action'
      )
    if name in baselines:
      raise errors.SpecError(
          f'agents: {name!r} is the name of a baseline; allowed are others'
      )
  numbers = {name: len(policies) for name, policies in agents.items()}
  if len(set(numbers.values())) > 1:
    raise errors.SpecError(
        f'agents: {numbers} policies; allowed are equal numbers, because agents'
        ' are compared in the same episodes'
    )
  return next(iter(numbers.values()))
