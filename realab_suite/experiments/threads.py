"""Keeps numerical libraries to one thread, before they are imported.

Two processes of one thread each do more on two cores than one of two threads,
and sums do not depend on how many threads have shared them.
"""

import os

from realab_suite import errors

_ONE = {
    'OMP_NUM_THREADS': '1',
    'OPENBLAS_NUM_THREADS': '1',
    'MKL_NUM_THREADS': '1',
    'VECLIB_MAXIMUM_THREADS': '1',
    'NUMEXPR_NUM_THREADS': '1',
}
_XLA_FLAGS = 'XLA_FLAGS'
_XLA_ONE = '--xla_cpu_multi_thread_eigen=false'


def use_one() -> None:
  """Sets the environment of this process and of those that it starts.

  Raises:
    SpecError: If XLA_FLAGS holds something else than flags. XLA reads none
      behind that, or ends the process.
  """
  os.environ.update(_ONE)
  flags = os.environ.get(_XLA_FLAGS, '').split()
  for flag in flags:
    if not flag.startswith('--'):
      raise errors.SpecError(
          f'{_XLA_FLAGS}: {flag!r:.80}; allowed are flags that begin with --,'
          f' as in {_XLA_ONE}'
      )
  os.environ[_XLA_FLAGS] = ' '.join([*xla_flags(), _XLA_ONE])


def xla_flags() -> list[str]:
  """Returns the flags of XLA but for those that `use_one` sets."""
  flags = os.environ.get(_XLA_FLAGS, '').split()
  return [flag for flag in flags if flag != _XLA_ONE]
