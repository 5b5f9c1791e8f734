"""Files of probes: what every action would do to a register, in a run's folder.

A run has such a file when somebody has probed its learner; see
`evaluation.incentives`.
"""

import dataclasses
import pathlib

from realab_suite import errors
from realab_suite.engine import snapshot as snapshots
from realab_suite.evaluation import incentives
from realab_suite.experiments import storage

PROBE = 'probe.bin'
LEARNER = 'learner'
"""What the run's own policy is called in a probe."""


def save(folder: pathlib.Path, probe: incentives.Probe) -> None:
  """Writes the probe of a run's policy into its folder.

  Args:
    folder: The folder of the run.
    probe: Its policy is called `LEARNER` in it; others are for comparison.

  Raises:
    ResultsError: If it cannot be written.
  """
  contents = {
      field.name: getattr(probe, field.name)
      for field in dataclasses.fields(probe)
  }
  contents['probabilities'] = dict(probe.probabilities)
  snapshot = snapshots.Snapshot({'kind': 'probe'}, contents)
  storage.write_whole(folder / PROBE, snapshot.to_bytes())


def load(folder: pathlib.Path) -> incentives.Probe | None:
  """Returns the probe of a run's policy; `None` if there is none.

  Raises:
    ResultsError: If the file is damaged.
  """
  path = folder / PROBE
  if not path.exists():
    return None
  with storage.explained(path):
    data = path.read_bytes()
  try:
    contents = snapshots.Snapshot.from_bytes(data).contents_for(
        {'kind': 'probe'}
    )
  except errors.StateLayoutError as error:
    raise errors.ResultsError(f'{path}: {error}') from error
  return incentives.Probe(**contents)
