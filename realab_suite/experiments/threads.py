"""Keeps numerical libraries to one thread, before they are imported.

Two processes of one thread each do more on two cores than one of two threads,
and sums do not depend on how many threads have shared them.
"""

import os

_ONE = {
    'OMP_NUM_THREADS': '1',
    'OPENBLAS_NUM_THREADS': '1',
    'MKL_NUM_THREADS': '1',
    'VECLIB_MAXIMUM_THREADS': '1',
    'NUMEXPR_NUM_THREADS': '1',
}
_XLA = '--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1'


def use_one() -> None:
  """Sets the environment of this process and of those that it starts."""
  os.environ.update(_ONE)
  given = os.environ.get('XLA_FLAGS', '')
  if _XLA not in given:
    os.environ['XLA_FLAGS'] = f'{given} {_XLA}'.strip()
