"""JAX settings that can change results, either pinned or recorded.

Environment variables and programs can change these settings, so the same
command could otherwise give other results, or a traceback, on another machine.
`pinned` affects only the computations of learners: a program that uses JAX
itself keeps its own settings.
"""

from collections.abc import Iterator
import contextlib
import os
from typing import Any

import jax

from realab_suite import errors
from realab_suite.config import messages

# Environment variables that choose devices.
_CHOICES = ('JAX_PLATFORMS', 'JAX_PLATFORM_NAME')

# Settings that can change results, but have no public context manager in JAX.
_RECORDED = (
    'eager_constant_folding',
    'jax_disable_jit',
    'jax_disable_most_optimizations',
    'jax_exec_time_optimization_effort',
    'jax_optimization_level',
    'jax_scan3',
)


@contextlib.contextmanager
def pinned() -> Iterator[None]:
  """Pins JAX settings, as a context manager or a decorator of a function."""
  with (
      jax.enable_x64(False),
      jax.default_matmul_precision('highest'),
      jax.numpy_dtype_promotion('standard'),
      jax.numpy_rank_promotion('allow'),
      # Learners pass raw pairs of numbers as random keys of this kind.
      jax.default_prng_impl('threefry2x32'),
      jax.threefry_partitionable(True),
      jax.legacy_prng_key('allow'),
      jax.transfer_guard('allow'),
  ):
    yield


def check_device() -> None:
  """Checks that JAX has a device.

  Raises:
    SpecError: If it has none; the message names the variables to change.
  """
  try:
    jax.devices()
  except Exception as error:  # JAX raises several classes.
    chosen = [f'{n}={os.environ[n]}' for n in _CHOICES if os.environ.get(n)]
    raise errors.SpecError(
        f'{" ".join(chosen) or "JAX"}: no such device for learners'
        f' ({messages.exception(error):.200}); must be cpu, another platform of'
        ' this machine, or unset'
    ) from error


def recorded() -> dict[str, Any]:
  """Returns the device, and the settings that are not pinned, by name."""
  device = jax.devices()[0]
  return {
      'jax_device': f'{device.platform}, {device.device_kind}',
      **{name: str(jax.config.values.get(name)) for name in _RECORDED},
  }
