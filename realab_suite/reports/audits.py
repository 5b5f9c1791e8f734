"""Reader of the audits beside the results of a sweep.

The launcher `audit` writes a file `audit.json`. Copied to `audits/<run>.json`
in the folder of the sweep, it tells whether the design of a run is exploitable.
"""

import pathlib

from realab_suite import errors
from realab_suite.experiments import audit
from realab_suite.experiments import scheduler
from realab_suite.experiments import storage
from realab_suite.reports import sweep_results

_IS_EXPLOITABLE = {audit.EXPLOITABLE: True, audit.RESISTED: False}


def is_exploitable(folder: pathlib.Path, run: sweep_results.Run) -> bool | None:
  """Returns True if the audit of a run's design found an exploit.

  Nothing can change the values of the channel `secure`, so it needs no audit.

  Args:
    folder: Folder of the sweep.
    run: The run.

  Returns:
    False if the design resisted, `None` without an audit.

  Raises:
    ResultsError: If the file of the audit is not valid.
  """
  if run.design.channel == 'secure':
    return False
  path = folder / scheduler.AUDITS / f'{run.name}.json'
  if not path.exists():
    return None
  content = storage.read_json(path)
  verdict = content.get('verdict') if isinstance(content, dict) else None
  if not isinstance(verdict, str) or verdict not in _IS_EXPLOITABLE:
    raise errors.ResultsError(
        f'{path}: verdict: {verdict!r:.80}; allowed are'
        f' {sorted(_IS_EXPLOITABLE)}'
    )
  return _IS_EXPLOITABLE[verdict]
