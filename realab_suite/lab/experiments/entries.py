"""Entries: published results of a named budget, with policies to check them by.

The folder `entries/<budget>/<entry>/` has the files of `publishing`, the
experiment with its designs, and the policy of each learner. `check` plays
episodes again with these policies, and compares their rows.
"""

from collections.abc import Callable, Iterator, Sequence
import contextlib
import json
import pathlib
import tempfile
from typing import Any, Final

import numpy as np

from realab_suite import errors
from realab_suite.config import messages
from realab_suite.engine import agent_view
from realab_suite.engine import batch_time_steps
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import results
from realab_suite.lab.experiments import budgets
from realab_suite.lab.experiments import experiment_specs
from realab_suite.lab.experiments import jobs
from realab_suite.lab.experiments import kept_stakes
from realab_suite.lab.experiments import machines
from realab_suite.lab.experiments import publishing
from realab_suite.lab.experiments import scheduler
from realab_suite.lab.experiments import storage
from realab_suite.lab.experiments import sweep_folders
from realab_suite.lab.experiments import training
from realab_suite.lab.verdicts import counted
from realab_suite.lab.verdicts import hacking
from realab_suite.lab.verdicts import premises
from realab_suite.lab.verdicts import stakes
from realab_suite.lab.verdicts import study
from realab_suite.policies import network_files

POLICIES: Final = 'policies.json'
"""File with the digests of the policies, by the names of their files."""

# Smallest number of episodes that are played again.
_NUM_REPLAYS = 20
# On another machine, the largest share of replays whose class, hacked or not,
# is not that of the row, and the largest relative difference of stakes.
_TOLERANCE = 0.25
_TOLERANCE_OF_STAKES = 0.05

_Rows = Sequence[tuple[jobs.Job, results.EpisodeResult]]


def publish(folder: pathlib.Path, output: pathlib.Path) -> tuple[int, int]:
  """Writes an entry from the folder of a sweep.

  Args:
    folder: Folder of the sweep, which may still be running.
    output: New or empty folder in a folder with the name of a budget.

  Returns:
    The numbers of published and of unfinished jobs.

  Raises:
    RealabError: As `publishing.publish` does, or if the sweep is not of the
      budget, or a learner has no policy that can be exported.
  """
  from realab_suite.lab.agents import network_export  # Imports JAX.

  _budget(output)
  sweep = sweep_folders.load(folder)
  experiment = _experiment(folder / scheduler.COPY, output)
  files = {scheduler.EXPERIMENT: (folder / scheduler.COPY).read_bytes()}
  digests = {}
  for job in jobs.plan(experiment):
    if job.policy is None and job.seed in sweep.runs[job.run].configs:
      name = job.folder()
      with _batch(job) as batch:
        learner = training.load_learner(job, folder / name, batch)
      network = network_export.export(
          learner,
          description=experiment.description,
          made={'job': name},
          reached=(),
      )
      digests[_file(job)] = network.digest()
      files[_file(job)] = network.to_bytes()
  counts = publishing.publish(folder, output)
  for name, data in files.items():
    storage.write_whole(output / name, data)
  storage.write_json(output / POLICIES, digests)
  return counts


def check(
    folder: pathlib.Path, draw: int | None, say: Callable[[str], None]
) -> None:
  """Checks an entry by playing episodes of each policy again.

  Args:
    folder: Folder of the entry.
    draw: Number that the choice of episodes follows, or `None` for a new one.
    say: Called with messages for the user.

  Raises:
    RealabError: If the entry is not of its budget, has been changed, lacks
      something, or has rows that are not those of its policies.
  """
  _budget(folder)
  if not (folder / POLICIES).is_file():
    raise errors.ResultsError(
        f'{folder}: has no {POLICIES}; must be a folder that `realab publish'
        ' --entry` has written'
    )
  sweep = publishing.load(folder)
  experiment = _experiment(folder / scheduler.EXPERIMENT, folder)
  planned = jobs.plan(experiment)
  published = {
      (run.name, seed) for run in sweep.runs.values() for seed in run.planned
  }
  is_whole = published == {(job.run, job.seed) for job in planned}
  if not sweep.has_imprints or not is_whole:
    raise errors.ResultsError(
        f'{folder}: has {len(published)} jobs; must have the {len(planned)} of'
        f' its {scheduler.EXPERIMENT}, with their digests'
    )
  rows, lacking = _rows(folder, sweep, planned)
  say(
      f'{folder}: {experiment.task}, task_kwargs {experiment.task_kwargs},'
      f' {experiment.max_steps} control steps at most; trained with'
      f' {experiment.training.task_kwargs}'
  )
  others = _others(folder)
  if others:
    words = ', '.join(others.values())
    say(f'Made with other {words}; no fault if the rows agree')
  _check_premises(folder, sweep)
  _check_stakes(folder, [one for of_job in rows.values() for one in of_job])
  draw = np.random.SeedSequence().generate_state(1)[0] if draw is None else draw
  generator = np.random.default_rng(draw)
  each = -(-_NUM_REPLAYS // len(rows))
  num_replays, num_differing, num_others = 0, 0, 0
  for of_job in rows.values():
    chosen = [of_job[i] for i in generator.permutation(len(of_job))[:each]]
    for job, row, result in _replayed(folder, of_job[0][0], chosen):
      num_replays += 1
      if _figures(result) == _figures(row):
        continue
      num_differing += 1
      num_others += _is_hacked(result, row) != _is_hacked(row, row)
      say(
          f'{job.run}, (seed, world, episode) {row.key}: true return'
          f' {row.true_return:g} and hacked {_is_hacked(row, row)} in the rows,'
          f' {result.true_return:g} and {_is_hacked(result, row)} here'
      )
  say(
      f'{num_replays - num_differing} of {num_replays} episodes are the same to'
      f' the bit, and {num_replays - num_others} hacked or not as in the rows'
      f' (--draw={draw})'
  )
  is_here = others.keys() <= {storage.CODE}
  if (num_differing and is_here) or num_others > _TOLERANCE * num_replays:
    raise errors.ResultsError(
        f'{folder}: the rows are not those of the policies: {num_differing} of'
        f' {num_replays} episodes differ'
    )
  if lacking:
    raise errors.ResultsError(
        f'{folder}: incomplete: lacks {len(lacking)} of {len(planned)} jobs,'
        f' the first of them {lacking[0]}'
    )


def _experiment(
    file: pathlib.Path, folder: pathlib.Path
) -> experiment_specs.ExperimentSpec:
  """Returns the experiment of an entry, which must be one of its budget."""
  experiment = experiment_specs.load(file)
  budgets.check(experiment, _budget(folder))
  return experiment


def _budget(folder: pathlib.Path) -> str:
  """Returns the name of the budget that the folder of an entry is in.

  Raises:
    UnknownNameError: If it is in another folder.
  """
  name = folder.absolute().parent.name
  if name not in budgets.BUDGETS:
    raise errors.UnknownNameError(
        f'{folder}: is in a folder {messages.quote(name)}; must be in one with'
        f' the name of a budget, {list(budgets.BUDGETS)}, such as'
        f' {folder.parent / next(iter(budgets.BUDGETS)) / folder.name}'
    )
  return name


@contextlib.contextmanager
def _batch(job: jobs.Job) -> Iterator[Any]:
  """Opens the worlds of a learner, for their specs and their number."""
  experiment = job.experiment
  with contextlib.closing(
      experiment.world.load_batch(job.design, experiment.training.num_envs, 0)
  ) as batch:
    yield batch


def _file(job: jobs.Job) -> str:
  """Returns the name of the file of a policy."""
  return f'{job.run}-{job.seed}.npz'


def _network(path: pathlib.Path) -> network_files.Network:
  """Returns the network of a file."""
  with storage.explained(path):
    return network_files.from_bytes(path.read_bytes(), str(path))


def _rows(
    folder: pathlib.Path,
    sweep: study.Study,
    planned: Sequence[jobs.Job],
) -> tuple[dict[str, _Rows], list[str]]:
  """Returns the rows of each finished learner, and the jobs that are missing.

  Raises:
    ResultsError: If a job is not of the experiment, or a policy is not the one
      that was published.
  """
  digests = storage.read_json(folder / POLICIES)
  lacking: list[str] = []
  rows: dict[str, _Rows] = {}
  for job in planned:
    run, name = sweep.runs[job.run], f'{job.run}, seed {job.seed}'
    if job.seed not in run.configs:
      lacking.append(name)
      continue
    there, here = (
        json.loads(json.dumps({**config, 'versions': None}))
        for config in (run.configs[job.seed], job.config())
    )
    if there != here:
      raise errors.ResultsError(
          f'{folder}: {name}: not of {scheduler.EXPERIMENT} in the present'
          f' world: {storage.difference(there, here)}'
      )
    if job.policy is None:
      path = folder / _file(job)
      found = _network(path).digest()
      storage.check_imprint(path, digests.get(path.name), found)
      evaluated = [(job, run)]
      if job.twin_of is not None:
        transplant = f'{job.twin_of}.{hacking.TRANSPLANT}'
        evaluated.append((job.transplant, sweep.runs[transplant]))
      rows[name] = [
          (one, row)
          for one, evaluation in evaluated
          for row in evaluation.rows
          if row.seed == job.evaluation_seed
      ]
  if not rows:
    raise errors.ResultsError(f'{folder}: has no policy')
  return rows, lacking


def _others(folder: pathlib.Path) -> dict[str, str]:
  """Returns versions and properties of the machine that others have here.

  They are described by the values in the entry.
  """
  content = storage.read_json(folder / sweep_folders.CONTENTS)
  there = [one['machine'] for part in content['machines'] for one in part]
  there += [config['versions'] for config in content['configs']]
  here = machines.here() | results.versions() | jobs.versions_of_learners()
  return {
      key: f'{key} ({value})'
      for one in there
      for key, value in one.items()
      if here.get(key, value) != value
  }


def _check_premises(folder: pathlib.Path, sweep: study.Study) -> None:
  """Refuses premises of judgements that others do not get."""
  runs = {
      premises.key_of(run.config): run
      for run in sweep.runs.values()
      if run.is_done
  }
  for key, there in sweep.collected.items():
    here = key in runs and premises.of(runs[key].world, runs[key].design)
    if here != there:
      raise errors.ResultsError(
          f'{folder}: has the premises {there}; here they are'
          f' {here or "of no run"}'
      )


def _check_stakes(folder: pathlib.Path, rows: _Rows) -> None:
  """Refuses stakes of rows, which decide what is hacked, that others get not.

  Raises:
    ResultsError: If they differ by more than machines do.
  """
  measured: dict[str, dict[str, float]] = {}
  with tempfile.TemporaryDirectory() as kept:
    for job, row in rows:
      if job.run not in measured:
        stake = kept_stakes.stakes_of(
            job.experiment.world, job.design, pathlib.Path(kept)
        )
        measured[job.run] = _figures_of(stake)
      there, here = _figures_of(stakes.of(row)), measured[job.run]
      if there.keys() != here.keys() or not np.allclose(
          [*there.values()], [*here.values()], rtol=_TOLERANCE_OF_STAKES
      ):
        raise errors.ResultsError(
            f'{folder}: {job.run}, (seed, world, episode) {row.key}: has the'
            f' stakes {there}; here they are {here}'
        )


def _figures_of(stake: stakes.Stakes | None) -> dict[str, float]:
  """Returns all figures of the stakes that labels depend on, by their names."""
  return {
      f'{name}.{figure}': float(getattr(part, figure))
      for name, part in (stake.parts if stake else {}).items()
      for figure in ('estimate', 'low', 'high', 'is_confirmed')
  }


def _replayed(
    folder: pathlib.Path, learned: jobs.Job, chosen: _Rows
) -> Iterator[tuple[jobs.Job, results.EpisodeResult, Any]]:
  """Yields rows of a learner, and their results when they are played again."""
  from realab_suite.lab.agents import network_export  # Imports JAX.

  with _batch(learned) as batch:
    learner = training.make_learner(learned, batch)
  network_export.restore(learner, _network(folder / _file(learned)))
  for job, row in chosen:
    yield job, row, _replay(job, learner, row)


def _replay(job: jobs.Job, learner: Any, row: results.EpisodeResult) -> Any:
  """Returns the result of an episode that a learner plays again.

  Actions are drawn for all episodes of the evaluation at once, so here they are
  drawn as often, for as many copies of the one world.
  """
  actor = training.evaluation_actor(job, learner)
  copies = job.experiment.evaluation.episodes
  with contextlib.closing(
      job.experiment.world.load(job.design, row.seed, row.world)
  ) as env:
    view = agent_view.AgentView(env)

    def play(unused_episode: int) -> Iterator[None]:
      time_step = view.reset()
      while not time_step.last():
        repeated = batch_time_steps.BatchTimeStep(
            step_type=np.full(copies, int(time_step.step_type)),
            reward=np.zeros(copies),
            discount=np.ones(copies),
            observation={
                name: np.stack([value] * copies)
                for name, value in time_step.observation.items()
            },
        )
        time_step = view.step(actor.act(repeated)[row.world])
        yield

    result, *_ = evaluate.results_of(env, play, 1, first_episode=row.episode)
  return result


def _figures(row: results.EpisodeResult) -> dict[str, Any]:
  """Returns all figures of an episode that the world alone decides."""
  return row.model_dump(exclude={'settings', 'extras'})


def _is_hacked(
    episode: results.EpisodeResult, row: results.EpisodeResult
) -> bool | None:
  """Returns whether an episode is hacked by the stakes of a row, or `None`."""
  stake = stakes.of(row)
  if stake is None:
    return None
  return counted.is_hacked(episode, stake, counted.SHARE_OF_STAKE)
