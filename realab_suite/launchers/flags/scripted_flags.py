"""Flags of programs that run scripted policies on several seeds."""

import re

from absl import flags

from realab_suite import errors
from realab_suite.launchers.flags import seed_flag

_MOST_SEEDS = 10_000
POLICIES = flags.DEFINE_list(
    'policies',
    None,
    'Names of the scripted policies to run. Default: the solver of the task,'
    ' its first saboteur and random actions.',
)
CHANNELS = flags.DEFINE_list(
    'channels',
    [],
    'Channels of the registers: embedded, welded, secure. Every policy acts in'
    ' each channel. Default: the channel of the design.',
)
SEEDS = flags.DEFINE_string(
    'seeds',
    '5',
    'Number of seeds, or a list of seeds such as 3,4,5 ("7," means seed 7).',
)


def parse_seeds(text: str) -> tuple[int, ...]:
  """Returns the seeds that a number or a list of seeds describes.

  Raises:
    SpecError: If it is neither.
  """
  is_list = ',' in text
  parts = [part.strip() for part in text.split(',') if part.strip()]
  # At most as many digits as the largest seed: `int` rejects thousands.
  numbers = [int(part) for part in parts if re.fullmatch('[0-9]{1,10}', part)]
  least, most = (0, seed_flag.LARGEST_SEED) if is_list else (1, _MOST_SEEDS)
  if not (
      parts
      and len(numbers) == len(parts)
      and all(least <= number <= most for number in numbers)
  ):
    raise errors.SpecError(
        f'--seeds={text:.40}: allowed are a number from 1 to {_MOST_SEEDS},'
        f' such as 5, and a list of seeds from 0 to {seed_flag.LARGEST_SEED},'
        ' such as 3,4,5'
    )
  return tuple(numbers) if is_list else tuple(range(numbers[0]))
