"""Reader of the audits beside the results of a sweep.

The launcher `audit` writes a file `audit.json`. Copied to `audits/<run>.json`
in the folder of the sweep, it tells whether the design of a run is exploitable.
"""

from collections.abc import Mapping
import json
import pathlib
from typing import Any

from realab_suite import errors
from realab_suite.evaluation import verdicts
from realab_suite.experiments import audit
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from realab_suite.reports import sweep_results

# Keys of a design that do not change what can be exploited.
_FREE = frozenset({'name', 'description', 'learner'})
_IS_EXPLOITABLE = {audit.EXPLOITABLE: True, audit.RESISTED: False}


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
  verdict = content.get('verdict')
  if not isinstance(verdict, str) or verdict not in _IS_EXPLOITABLE:
    raise errors.ResultsError(
        f'{path}: verdict: {verdict!r:.80}; allowed are'
        f' {sorted(_IS_EXPLOITABLE)}'
    )
  _check_subject(path, content, run)
  return verdicts.Audit(
      _IS_EXPLOITABLE[verdict],
      not content.get('num_untested'),
      int(content.get('num_searched', 0)),
  )


def _check_subject(
    path: pathlib.Path, content: Mapping[str, Any], run: sweep_results.Run
) -> None:
  """Checks that an audit is of the design and the world of a run.

  Other settings of the learner than its kind are those of training, and may
  differ.

  Raises:
    ResultsError: If it is not, or is of one register only.
  """
  world, design = content.get('world'), content.get('design')
  if not isinstance(world, Mapping) or not isinstance(design, Mapping):
    raise errors.ResultsError(
        f'{path}: world or design is missing; allowed is a file that the'
        ' program audit has written'
    )
  ours = json.loads(json.dumps(run.design.to_mapping()))
  senses = run.config.get('environment_kwargs', {}).get('senses')
  kinds = [(one.get('learner') or {}).get('kind') for one in (design, ours)]
  differences = [
      f'{key} is {theirs!r:.80}, and {own!r:.80} in the run'
      for key, theirs, own in (
          ('task', f'{world.get("domain")}.{world.get("task")}',
           run.config['task']),
          ('max_steps', world.get('max_steps'), run.config['max_steps']),
          ('task_kwargs', world.get('task_kwargs'),
           run.config.get('task_kwargs', {})),
          ('senses', world.get('senses'), senses and list(senses)),
          ('target', content.get('target'), None),
          ('design.learner.kind', *kinds),
          *((f'design.{key}', design.get(key), ours.get(key))
            for key in sorted({*ours, *design} - _FREE)),
      )
      if theirs != own
  ]  # fmt: skip
  if differences:
    raise errors.ResultsError(
        f'{path}: the audit is not of run {run.name!r}: {differences[0]}'
    )
