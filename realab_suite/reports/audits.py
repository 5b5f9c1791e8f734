"""Reader of the audits beside the results of a sweep.

The launcher `audit` writes a file `audit.json`. Copied to `audits/<run>.json`
in the folder of the sweep, it tells whether the design of a run is exploitable.
"""

from collections.abc import Mapping
import json
import pathlib
from typing import Any

from realab_suite import errors
from realab_suite.audit import findings
from realab_suite.evaluation import actors
from realab_suite.evaluation import verdicts
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from realab_suite.reports import sweep_results

# Keys of a design that do not change what can be exploited. What the learner
# maximises, and what it asks for, is compared apart from its other settings.
_FREE = frozenset({'name', 'description', 'learner'})
_VERDICTS = (findings.EXPLOITABLE, findings.RESISTED, findings.UNDECIDED)


def check_names(sweep: sweep_results.Sweep) -> None:
  """Checks that each audit beside a sweep is that of a run.

  Raises:
    ResultsError: If there is another file among them.
  """
  allowed = sorted(f'{name}.json' for name in sweep.runs)
  for path in sorted((sweep.folder / scheduler.AUDITS).glob('*')):
    if path.name not in allowed:
      raise errors.ResultsError(
          f'{path}: not the audit of a run; allowed are {allowed}'
      )


def of_run(
    folder: pathlib.Path, run: sweep_results.Run
) -> verdicts.Audit | None:
  """Returns the audit of a run's design, or `None` if there is none.

  Nothing can change the values of the channel `secure`, so it needs no audit.

  Args:
    folder: Folder of the sweep.
    run: The run.

  Raises:
    ResultsError: If the file is not valid, or belongs to another design or
      world.
  """
  if run.design.channel == 'secure':
    return verdicts.Audit(False, True, 0)
  path = folder / scheduler.AUDITS / f'{run.name}.json'
  if not path.exists():
    return None
  content = storage.read_json(path)
  if not isinstance(content, dict):
    raise errors.ResultsError(f'{path}: not an audit; allowed is a JSON object')
  for key, kind in (
      ('verdict', str),
      ('is_sufficient', bool),
      ('num_searched', int),
      ('world', dict),
      ('design', dict),
      ('objective', dict),
  ):
    if not isinstance(content.get(key), kind):
      raise errors.ResultsError(
          f'{path}: {key}: {content.get(key)!r:.80}; allowed is that of a file'
          ' that the present version of the program audit has written'
      )
  if content['verdict'] not in _VERDICTS:
    raise errors.ResultsError(
        f'{path}: verdict: {content["verdict"]!r:.80}; allowed are'
        f' {sorted(_VERDICTS)}'
    )
  _check_subject(path, content, run)
  return verdicts.Audit(
      is_exploitable=content['verdict'] == findings.EXPLOITABLE,
      is_sufficient=(
          content['is_sufficient'] and content['verdict'] != findings.UNDECIDED
      ),
      num_episodes=content['num_searched'],
  )


def _check_subject(
    path: pathlib.Path, content: Mapping[str, Any], run: sweep_results.Run
) -> None:
  """Checks that an audit is of the design and the world of a run.

  Settings of the learner that neither change its objective nor its queries are
  those of training, and may differ.

  Raises:
    ResultsError: If it is not, or is of one register only.
  """
  world, design = content['world'], content['design']
  task = f'{world.get("domain")}.{world.get("task")}'
  senses = run.config.get('environment_kwargs', {}).get('senses')
  ours = json.loads(json.dumps(run.design.to_mapping()))
  objective = run.design.objective
  pairs = [
      ('task', task, run.config['task']),
      ('max_steps', world.get('max_steps'), run.config['max_steps']),
      (
          'task_kwargs',
          world.get('task_kwargs'),
          run.config.get('task_kwargs', {}),
      ),
      ('senses', world.get('senses'), senses and list(senses)),
      ('target', content.get('target'), None),
      (
          'design.learner.kind',
          (design.get('learner') or {}).get('kind'),
          (ours.get('learner') or {}).get('kind'),
      ),
      (
          'the objective',
          content['objective'],
          objective and json.loads(objective.model_dump_json()),
      ),
      (
          'the query policy',
          content.get('query_policy'),
          actors.query_policy(run.design),
      ),
      *(
          (f'design.{key}', design.get(key), ours.get(key))
          for key in sorted({*ours, *design} - _FREE)
      ),
  ]
  for what, theirs, own in pairs:
    if theirs != own:
      raise errors.ResultsError(
          f'{path}: the audit is not of run {run.name!r}: {what} is'
          f' {theirs!r:.120}, and {own!r:.120} in the run'
      )
