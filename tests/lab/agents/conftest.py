"""Leaves tests out without JAX, and turns off slow optimisations of XLA."""

import importlib.util
import os

# JAX, optax and equinox are in the extra `agents`.
if importlib.util.find_spec('equinox') is None:
  collect_ignore_glob = ['*_test.py']

# They take longer than toys run. JAX is not imported yet: nothing else in this
# package needs it.
os.environ.setdefault(
    'XLA_FLAGS',
    '--xla_backend_optimization_level=0'
    ' --xla_llvm_disable_expensive_passes=true'
    ' --xla_cpu_multi_thread_eigen=false',
)
