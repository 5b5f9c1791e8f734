"""Properties of the machine that affect results and cannot be pinned.

The same versions and seeds give the same results, bit for bit, if all of these
properties are equal. Otherwise sums and sines may differ in their last bits.
"""

import os
import pathlib
import platform
import re
from typing import Any

import numpy as np

from realab_suite.config import validation
from realab_suite.lab.experiments import threads

# Variables with which libraries choose between implementations of a function.
_VARIABLES = (
    'DNNL_MAX_CPU_ISA',
    'GLIBC_TUNABLES',
    'ONEDNN_MAX_CPU_ISA',
    'OPENBLAS_CORETYPE',
)
_CPU_INFO = pathlib.Path('/proc/cpuinfo')


def here() -> dict[str, Any]:
  """Returns a description of this machine and process, as plain data."""
  config: Any = np.show_config(mode='dicts')
  blas = config['Build Dependencies']['blas']
  return {
      'system': f'{platform.system()} {platform.machine()}',
      'libc': ' '.join(platform.libc_ver()).strip() or platform.mac_ver()[0],
      'processor': _processor(),
      'instructions': ' '.join(config['SIMD Extensions'].get('found', [])),
      'blas': f'{blas["name"]} {blas.get("version", "")}'.strip(),
      **{name: os.environ.get(name, '') for name in _VARIABLES},
      'XLA_FLAGS': ' '.join(threads.xla_flags()),
  }


def keep_compiled(folder: pathlib.Path) -> None:
  """Lets JAX, before it is imported, keep what it compiles on this machine.

  Args:
    folder: Folder of an experiment.
  """
  name = validation.digest_of({**here(), 'name': platform.node()})
  compiled = str(folder / 'compiled' / name)
  os.environ.setdefault('JAX_COMPILATION_CACHE_DIR', compiled)


def _processor() -> str:
  """Returns the model name of the processor."""
  try:
    text = _CPU_INFO.read_text(encoding='utf-8', errors='replace')
  except OSError:
    return platform.processor()
  match = re.search(r'^(?:model name|CPU part)\s*:\s*(.+)$', text, re.MULTILINE)
  return match[1].strip() if match else platform.processor()
