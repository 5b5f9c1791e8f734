"""Campaign C39: no result row that was damaged is taken for one that was not.

Run from the root of the repository, about two minutes:

    python -m campaigns.rows_campaign [scale] [seed]

Files of rows are damaged 10,000 times: bits are flipped, stretches become
zeros, files end early, rows are spliced out of two, and tails are torn. Reading
one has to give rows as they were written until it says what is wrong; of a torn
tail it has to say so and give all rows before it. The same is done to the lines
that training writes, to checkpoints and to `done.json`, which have checksums
of their own.
"""

from collections.abc import Callable, Sequence
import dataclasses
import json
import pathlib
import shutil
import tempfile
from typing import final
import warnings

import numpy as np

from campaigns import figure_lines
from realab_suite import errors
from realab_suite.evaluation import metrics
from realab_suite.evaluation import results
from realab_suite.experiments import storage

TIMES = 10_000
_NUM_ROWS = 6
_HEADER = {'configuration': 'campaign'}

Damage = Callable[[np.random.Generator, bytes], bytes]


def _flip(rng: np.random.Generator, data: bytes) -> bytes:
  spoilt = bytearray(data)
  for place in rng.integers(len(data), size=rng.integers(1, 4)):
    spoilt[place] ^= 1 << int(rng.integers(8))
  return bytes(spoilt)


def _zero(rng: np.random.Generator, data: bytes) -> bytes:
  start, end = np.sort(rng.integers(len(data) + 1, size=2))
  return data[:start] + bytes(int(end - start)) + data[end:]


def _zero_all(rng: np.random.Generator, data: bytes) -> bytes:
  return bytes(len(data))


def _truncate(rng: np.random.Generator, data: bytes) -> bytes:
  return data[: rng.integers(len(data))]


def _splice(rng: np.random.Generator, data: bytes) -> bytes:
  """Leaves out a stretch, so that one row begins and another goes on."""
  start, end = np.sort(rng.integers(len(data) + 1, size=2))
  return data[:start] + data[end:]


def _repeat(rng: np.random.Generator, data: bytes) -> bytes:
  start, end = np.sort(rng.integers(len(data) + 1, size=2))
  return data[:end] + data[start:]


def _digit(rng: np.random.Generator, data: bytes) -> bytes:
  """Changes a digit to another one, so that JSON stays JSON."""
  places = [i for i, byte in enumerate(data) if 48 <= byte < 58]
  place = places[rng.integers(len(places))]
  digit = 48 + (data[place] - 48 + int(rng.integers(1, 10))) % 10
  return data[:place] + bytes([digit]) + data[place + 1 :]


DAMAGES: dict[str, Damage] = {
    'bits flipped': _flip,
    'zeros within': _zero,
    'all zeros': _zero_all,
    'truncated': _truncate,
    'spliced': _splice,
    'repeated': _repeat,
    'a digit changed': _digit,
}


@final
@dataclasses.dataclass
class Tally:
  """What became of damaged files.

  Attributes:
    damaged: How many were damaged.
    noticed: How many reading refused, or warned of.
    accepted: Rows that were read and never written.
    lost: Rows before the damage that were not read.
    unnoticed: Files that lack rows or bytes, of which nothing was said.
  """

  damaged: int = 0
  noticed: int = 0
  accepted: int = 0
  lost: int = 0
  unnoticed: int = 0


def rows(rng: np.random.Generator) -> list[results.EpisodeRow]:
  """Returns rows of some episodes."""
  info = results.RunInfo(
      domain='unlock_door', task='near', dynamics_version=1,
      dynamics_digest='0123456789abcdef', design='instantaneous_reward',
      design_digest='fedcba9876543210', channel='embedded', policy='random',
      run='random', baseline=None, control_timestep=0.1, max_steps=250,
  )  # fmt: skip
  return [
      results.EpisodeRow(
          info=info, seed=int(rng.integers(100)), world=0, episode=episode,
          end='timeout', is_valid=True, true_return=float(rng.normal()),
          observed_return=float(rng.normal()),
          corruption=float(rng.exponential()),
          registers={'reward': _register(rng)},
          facts={'apples': float(rng.integers(8))}, num_steps=250,
          num_substeps=2500, num_provider_calls=250, num_queries=0,
      )
      for episode in range(_NUM_ROWS)
  ]  # fmt: skip


def _register(rng: np.random.Generator) -> metrics.RegisterMetrics:
  values = rng.normal(size=9).tolist()
  return metrics.RegisterMetrics(
      corruption=values[0], corruption_metres=values[1],
      corruption_max=values[2], corruption_signed=values[3],
      permanent=values[4], temporary=values[5], saturation=values[6],
      requested_sum=values[7], agent_reading_sum=values[8], num_writes=251,
      num_reads=251, num_reads_before_write=0, num_writes_read=251,
      coverage=1.0,
  )  # fmt: skip


def damage_rows(
    path: pathlib.Path,
    written: Sequence[results.EpisodeRow],
    data: bytes,
    damaged: bytes,
    tally: Tally,
) -> None:
  """Reads a file of rows that is not what it was, and counts.

  Args:
    path: Where to put the file.
    written: The rows that were written.
    data: What the file was.
    damaged: What it is; something else.
    tally: What to count in.
  """
  path.write_bytes(damaged)
  found = []
  is_noticed = False
  with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter('always')
    try:
      for row in results.read_rows(path):
        found.append(repr(row))
    except errors.ResultsError:
      is_noticed = True
  is_noticed |= bool(caught)
  tally.damaged += 1
  tally.noticed += is_noticed
  tally.accepted += sum(row not in map(repr, written) for row in found)
  tally.lost += max(_rows_before(data, damaged) - len(found), 0)
  # Whole lines may be gone, or there twice, without a trace in the file; what
  # they say is true, and `done.json` knows of them.
  leaves_whole_lines = set(damaged.split(b'\n')) <= set(data.split(b'\n'))
  tally.unnoticed += not is_noticed and not leaves_whole_lines


def _rows_before(data: bytes, damaged: bytes) -> int:
  """Returns how many rows are as they were, up to the first that is not."""
  pairs = zip(data.split(b'\n')[:-1], damaged.split(b'\n')[:-1], strict=False)
  count = 0
  for before, after in pairs:
    if before != after:
      break
    count += 1
  return count


def damage_folder(
    folder: pathlib.Path, damage: Damage, rng: np.random.Generator
) -> bool:
  """Damages a file of a run; returns whether whoever goes on refuses it."""
  config = {'run': 'random'}
  lines = [{'step': i, 'true_return': float(rng.normal())} for i in range(9)]
  name = ('curve.jsonl', 'checkpoint', storage.DONE)[rng.integers(3)]
  with storage.RunFolder(folder, config) as run:
    file = storage.JsonLines(folder / 'curve.jsonl', storage.NOTHING)
    file.append(lines)
    mark = file.sync()
    file.close()
    if name == storage.DONE:
      run.finish(['curve.jsonl'], {'steps': 48})
      path = folder / name
    else:
      run.save(9, _HEADER, {'mark': mark, 'values': rng.normal(size=9)})
      path = next((folder / 'checkpoints').iterdir())
      path = folder / name if name == 'curve.jsonl' else path
  data = path.read_bytes()
  while (damaged := damage(rng, data)) == data or damaged.startswith(data):
    pass  # What is behind the mark was written later, and is cut off.
  path.write_bytes(damaged)
  try:
    with storage.RunFolder(folder, config) as run:
      if not storage.is_done(folder):
        contents = run.load(_HEADER)
        storage.JsonLines(folder / 'curve.jsonl', contents['mark']).close()
  except errors.ResultsError:
    return True
  # JSON may be laid out otherwise and say the same.
  return name == storage.DONE and _same_json(data, damaged)


def _same_json(one: bytes, other: bytes) -> bool:
  try:
    return bool(json.loads(one) == json.loads(other))
  except ValueError:
    return False


def damage_many(times: int, rng: np.random.Generator) -> tuple[Tally, int, int]:
  """Damages files of rows, and a tenth as many other files.

  Returns:
    What became of the rows, how many other files were damaged, and how many of
    them were taken for whole.
  """
  tally = Tally()
  others = taken = 0
  damages = list(DAMAGES.values())
  with tempfile.TemporaryDirectory() as name:
    folder = pathlib.Path(name)
    for i in range(times):
      if i % 100 == 0:
        written = rows(rng)
        data = b''.join(results.line(row) for row in written)
      damage = damages[i % len(damages)]
      while (damaged := damage(rng, data)) == data:
        pass
      damage_rows(folder / 'rows', written, data, damaged, tally)
      if i % 10 == 0:
        others += 1
        damage = damages[i // 10 % len(damages)]
        taken += not damage_folder(folder / str(i), damage, rng)
        shutil.rmtree(folder / str(i))
  return tally, others, taken


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints every figure and returns the number of targets missed."""
  lines = figure_lines.Lines('C39', seed)
  rng = np.random.default_rng(seed)
  tally, others, taken = damage_many(round(scale * TIMES), rng)
  lines.at_least('files of rows damaged', tally.damaged, scale * TIMES)
  lines.at_least('damages noticed', tally.noticed, tally.damaged / 2)
  lines.at_most('rows accepted though damaged', tally.accepted, 0)
  lines.at_most('good rows lost', tally.lost, 0)
  lines.at_most('damages unnoticed', tally.unnoticed, 0)
  lines.at_least('other files damaged', others, scale * TIMES / 10)
  lines.at_most('other files taken for whole', taken, 0)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
