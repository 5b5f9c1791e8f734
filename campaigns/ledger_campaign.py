"""Campaign C41: random streams of events against an oracle.

Run from the root of the repository, about half a minute:

    python -m campaigns.ledger_campaign [scale] [seed]

5,000 random episodes of writes and reads go through the ledger of one world,
which is saved and restored in the middle of some of them, and through that of
many worlds, and then through the metrics. What comes out has to be what a brute
force oracle finds in the events themselves, to the last bit. Then there are the
cases that were worked out by hand.
"""

from collections.abc import Sequence

import numpy as np

from campaigns import figure_lines
from realab_suite.engine import events
from realab_suite.evaluation import ledgers
from realab_suite.evaluation import metrics
from tests.evaluation import streams

STREAMS = 5_000
_NUM_ENVS = 4
_ENDS = [*events.End]


def _mismatches(
    steps: Sequence[Sequence[streams.Record]], episode: ledgers.EpisodeLedger
) -> int:
  return sum(
      streams.measured(episode, name)
      != streams.oracle(steps, name, streams.SCALE)
      for name in streams.REGISTERS
  )


def alone(rng: np.random.Generator) -> int:
  """Returns the mismatches of a random episode in the ledger of one world."""
  steps = streams.decode(rng.bytes(4 * rng.integers(40)))
  end = _ENDS[rng.integers(len(_ENDS))]
  ledger = ledgers.Ledger()
  streams.tell(ledger, [[]], events.End.TIMEOUT)  # Somebody was here before.
  cut = int(rng.integers(1, len(steps) + 1))
  streams.tell(ledger, steps[:cut], None)
  if rng.random() < 0.5:
    state, ledger = ledger.state(), ledgers.Ledger()
    ledger.set_state(state)
  for records in steps[cut:]:
    ledger.step_ended(events.Step(records, np.array(0.0)), None)
  ledger.episode_ended(end)
  return _mismatches(steps, ledger.last) + (ledger.last.end is not end)


def together(rng: np.random.Generator) -> tuple[int, int]:
  """Plays random episodes in many worlds.

  Returns:
    How many episodes there were, and how many mismatches.
  """
  ledger = ledgers.BatchLedger()
  played: list[list[list[list[streams.Record]]]] = [
      [] for _ in range(_NUM_ENVS)
  ]
  is_open = np.zeros(_NUM_ENVS, bool)
  for _ in range(rng.integers(1, 20)):
    is_first = ~is_open | (rng.random(_NUM_ENVS) < 0.1)
    has_failed = ~is_first & (rng.random(_NUM_ENVS) < 0.1)
    now = np.where(is_first, 0, 1)
    initial, records, reads = (
        _of_all(rng, step) for step in (0 * now, 0 * now + 1, now)
    )
    over = has_failed | (rng.random(_NUM_ENVS) < 0.1)
    ends = {
        world: events.End.DIVERGENCE if failed else events.End.TIMEOUT
        for world, failed in enumerate(has_failed)
        if over[world]
    }
    ledger.step_ended(
        events.BatchStep(
            seed=np.zeros(_NUM_ENVS, int),
            world=np.arange(_NUM_ENVS),
            episode=np.array([len(one) for one in played]),
            is_first=is_first, has_failed=has_failed, ends=ends,
            initial=initial, records=records, agent_reads=reads,
            true_reward=np.zeros(_NUM_ENVS),
        )
    )  # fmt: skip
    for world, episodes in enumerate(played):
      if is_first[world]:
        episodes.append([_of_one(world, [*initial, *reads])])
      elif not has_failed[world]:
        episodes[-1].append(_of_one(world, [*records, *reads]))
    is_open = ~over
  count = mismatches = 0
  for world, episodes in enumerate(played):
    found = ledger.episodes(world)
    mismatches += len(found) != len(episodes)
    for steps, episode in zip(episodes, found, strict=False):
      count += 1
      mismatches += _mismatches(steps, episode)
  return count, mismatches


def _of_all(rng: np.random.Generator, step: np.ndarray) -> list[streams.Record]:
  """Returns some records of all worlds at once."""
  alone = [streams.decode(rng.bytes(4))[0][0] for _ in range(rng.integers(5))]
  return [
      type(record)(
          *record[:2],
          step,
          *(value + rng.integers(-9, 9, _NUM_ENVS) / 8 for value in record[3:]),
      )
      for record in alone
  ]


def _of_one(
    world: int, records: Sequence[streams.Record]
) -> list[streams.Record]:
  return [
      type(one)(*one[:2], *(value[world] for value in one[2:]))
      for one in records
  ]


def hand_cases() -> tuple[int, int]:
  """Returns how many cases there are, and in how many something else came."""
  wrong = 0
  for steps, end, expected in streams.BY_HAND.values():
    ledger = ledgers.Ledger()
    streams.tell(ledger, steps, end)
    # By `repr`, as nan is unequal to itself.
    found = repr(streams.measured(ledger.last))
    wrong += found != repr(metrics.RegisterMetrics(**expected))
  return len(streams.BY_HAND), wrong


def compare(count: int, rng: np.random.Generator) -> tuple[int, int]:
  """Returns how many streams were compared, at least `count`, and how many
  mismatches there were.
  """
  streams_done = mismatches = 0
  while streams_done < count:
    mismatches += alone(rng)
    streams_done += 1
    if streams_done % 10 == 0:
      more, wrong = together(rng)
      streams_done += more
      mismatches += wrong
  return streams_done, mismatches


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints every figure and returns the number of targets missed."""
  lines = figure_lines.Lines('C41', seed)
  count = round(scale * STREAMS)
  compared, wrong = compare(count, np.random.default_rng(seed))
  lines.at_least('streams', compared, count)
  lines.at_most('mismatches', wrong, 0)
  cases, wrong = hand_cases()
  lines.at_least('cases by hand', cases, 14)
  lines.at_most('cases by hand that came out otherwise', wrong, 0)
  return lines.num_missed


if __name__ == '__main__':
  figure_lines.run(main)
