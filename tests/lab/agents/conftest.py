"""Turns off optimisations of XLA that take longer than toys run."""

import os

# jax is not imported yet: nothing else in this package needs it.
os.environ.setdefault(
    'XLA_FLAGS',
    '--xla_backend_optimization_level=0'
    ' --xla_llvm_disable_expensive_passes=true'
    ' --xla_cpu_multi_thread_eigen=false',
)
