"""Campaign C26: clients that leave, at every point and in every way.

Run from the root of the repository, about twenty minutes in full:

    python -m campaigns.served_departures_campaign

They cancel, close, are killed, or are stopped. Clients that were stopped for
half a minute continue while another client plays. The server is a process of
its own. Prints `C26 figure target verdict seed`.
Arguments are the scale and the seed.
"""

from collections.abc import Callable, Sequence
import os
import pathlib
import signal
import tempfile
import time
from typing import Any, NamedTuple, final

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
import grpc

from campaigns import figure_lines
from tests import patience
from tests import zygote
from tests.interop import served

REPETITIONS = 50
STOPPED_SECONDS = 30.0
IDLE_SECONDS = 1.0
# This module; `__name__` is `__main__` if it is run.
_MODULE = 'campaigns.served_departures_campaign'


def _ask_without_waiting(stream: served.RawStream) -> None:
  stream.tell(served.STEP)


_OUTSIDE = served.request(create_world=pb.CreateWorldRequest())
# Requests of a client before it leaves, in turn.
POINTS: dict[str, list[bytes | Callable[[served.RawStream], None]]] = {
    'connected': [served.LEAVE],
    'joined': [served.JOIN],
    'refused': [_OUTSIDE],
    'joined and refused': [served.JOIN, served.JOIN],
    'first step': [served.JOIN, served.STEP],
    'second step': [served.JOIN, served.STEP, served.STEP],
    'refused in mid-episode': [
        served.JOIN,
        served.STEP,
        served.request(step=pb.StepRequest()),
    ],
    'last step': [served.JOIN, *[served.STEP] * 21],
    'reset after the last step': [
        served.JOIN,
        *[served.STEP] * 21,
        served.RESET,
    ],
    'second episode': [served.JOIN, *[served.STEP] * 22],
    'left in mid-episode': [served.JOIN, served.STEP, served.LEAVE],
    'waiting for an answer': [served.JOIN, served.STEP, _ask_without_waiting],
}
_IS_MID_EPISODE = (
    'first step',
    'second step',
    'refused in mid-episode',
    'second episode',
    'waiting for an answer',
)
WAYS = ('cancel', 'close', 'kill', 'stop')


def go_to(address: str, point: int) -> served.RawStream:
  """Connects, and sends the requests that lead to a point."""
  stream = served.connect_eventually(address)
  for act in list(POINTS.values())[point]:
    if callable(act):
      act(stream)
    else:
      stream.ask(act)
  return stream


def go_and_stay(address: str, point: int, sign: str) -> None:
  """Goes to a point, creates a file, and waits for SIGCONT, then continues.

  Args:
    address: Address of the server.
    point: Index of `POINTS`.
    sign: File to create when the point is reached.
  """
  # Before other threads exist, which would receive the signal.
  signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCONT])
  stream = go_to(address, point)
  pathlib.Path(sign).touch()
  if signal.sigtimedwait([signal.SIGCONT], patience.SECONDS) is not None:
    for request in (served.STEP, served.JOIN, served.STEP):
      stream.tell(request)
    time.sleep(0.5)
    print('woke up')


@final
class Clients:
  """Clients that are processes, so that they can be killed and stopped."""

  def __init__(self, address: str) -> None:
    self._address = address
    self._nursery = zygote.Zygote(_MODULE)
    self._folder = tempfile.TemporaryDirectory()
    self._number = 0

  def __enter__(self) -> 'Clients':
    self._nursery.__enter__()
    return self

  def __exit__(self, *unused: Any) -> None:
    self._nursery.__exit__(*unused)
    self._folder.cleanup()

  def start(self, point: int) -> int:
    """Returns the id of a process that has reached a point."""
    self._number += 1
    sign = pathlib.Path(self._folder.name, str(self._number))
    pid = self._nursery.start(
        'go_and_stay', address=self._address, point=point, sign=str(sign)
    )
    patience.until(sign.exists)
    return pid

  def wait(self, pid: int) -> zygote.Ended:
    """Waits for the end of a process."""
    return self._nursery.wait(pid)


@final
class Leaving(NamedTuple):
  """Result of a client that left."""

  seconds_until_free: float
  is_clean: bool
  seconds_until_refused: float


def go_away(
    address: str,
    point: int,
    way: str,
    clients: Clients,
    let_idle: Callable[[], None] = lambda: None,
) -> Leaving:
  """Goes to a point, then leaves; returns the result for the next client.

  Args:
    address: Address of the server.
    point: Index of `POINTS`.
    way: One of `WAYS`.
    clients: Starts clients that can be killed and stopped.
    let_idle: Called until a stopped client has lost the world; advances the
      server's clock, if that is not the real one.
  """
  stream = pid = None
  if way in ('kill', 'stop'):
    pid = clients.start(point)
  else:
    stream = go_to(address, point)
  refused_after = _time_of_refusal(address)
  start = time.monotonic()
  if way == 'kill':
    os.kill(pid, signal.SIGKILL)
  elif way == 'stop':
    os.kill(pid, signal.SIGSTOP)
    start += IDLE_SECONDS
  elif way == 'cancel':
    stream.cancel()
  else:
    stream.channel.close()
  following = served.connect_eventually(
      address, let_idle if way == 'stop' else lambda: None
  )
  free_after = time.monotonic() - start
  is_clean = _begins_clean(following, address)
  if way == 'stop':
    os.kill(pid, signal.SIGKILL)
  if pid is not None:
    clients.wait(pid)
  if stream is not None:
    stream.close()
  return Leaving(free_after, is_clean, refused_after)


def _begins_clean(following: served.RawStream, address: str) -> bool:
  """Joins, and returns True if that begins an episode.

  A busy virtual machine may pause for a second. The server then rightly rejects
  this client as idle, and the client tries again once. If there was no pause,
  the error is raised.
  """
  for is_last in (False, True):
    start = time.monotonic()
    try:
      following.ask(served.JOIN)
      answer = served.response(following.ask(served.STEP)).step
      following.ask(served.LEAVE)
    except grpc.RpcError:
      if is_last or time.monotonic() - start < IDLE_SECONDS:
        raise
      print('# C26: this machine paused for a second', flush=True)
      following.close()
      following = served.connect_eventually(address)
      continue
    break
  following.close()
  return answer.state == pb.RUNNING and len(answer.observations) == 4


def _time_of_refusal(address: str) -> float:
  with served.Client(address) as second:
    call = second.channel.stream_stream(served.METHOD)
    for _ in range(2):  # The first one connects.
      start = time.monotonic()
      try:
        next(call(iter([served.JOIN])))
      except grpc.RpcError as error:
        if error.code() is not grpc.StatusCode.RESOURCE_EXHAUSTED:
          break
      else:
        break
    else:
      return time.monotonic() - start
  return float('inf')


def go_away_everywhere(
    address: str,
    repetitions: int,
    ways: Sequence[str] = WAYS,
    points: Sequence[int] = range(len(POINTS)),
    let_idle: Callable[[], None] = lambda: None,
) -> list[Leaving]:
  """Leaves from every point in every way; see `go_away`."""
  with Clients(address) as clients:
    return [
        go_away(address, point, way, clients, let_idle)
        for _ in range(repetitions)
        for way in ways
        for point in points
    ]


@final
class Waking(NamedTuple):
  """Result of clients that were stopped, and continued later.

  Attributes:
    num_awake: Number of clients that continued.
    seconds: Least time that each one was stopped, in s.
    is_undisturbed: True if the client that played meanwhile received the same
      as without them.
  """

  num_awake: int
  seconds: float
  is_undisturbed: bool


def wake_up_late(
    address: str,
    seconds: float,
    points: Sequence[int] = range(len(POINTS)),
    let_idle: Callable[[], None] = lambda: None,
) -> Waking:
  """Stops clients at points, and continues them while another one plays.

  Args:
    address: Address of the server.
    seconds: Time for which all of them are stopped, in s.
    points: Indices of `POINTS`.
    let_idle: As in `go_away`.
  """
  expected = play(address)
  with Clients(address) as clients:
    pids = []
    for point in points:
      pids.append(clients.start(point))
      os.kill(pids[-1], signal.SIGSTOP)
      # Once it has been idle for long enough.
      served.connect_eventually(address, let_idle).close()
    start = time.monotonic()
    time.sleep(seconds)

    def wake() -> None:
      for pid in pids:
        os.kill(pid, signal.SIGCONT)

    stopped = time.monotonic() - start
    found = play(address, wake)
    ends = [clients.wait(pid) for pid in pids]
  return Waking(
      sum('woke up' in end.said for end in ends), stopped, found == expected
  )


def play(
    address: str, meanwhile: Callable[[], None] = lambda: None
) -> list[tuple[int, int]]:
  """Plays for more than an episode, for about a second.

  Args:
    address: Address of the server.
    meanwhile: Called in mid-episode.

  Returns:
    State and number of observations of each answer, which a step or reset of
    another client would shift.
  """
  stream = served.connect_eventually(address)
  stream.ask(served.JOIN)
  found = []
  for i in range(50):
    if i == 8:
      meanwhile()
    step = served.response(stream.ask(served.STEP)).step
    found.append((step.state, len(step.observations)))
    time.sleep(0.02)
  stream.close()
  return found


def main(scale: float = 1.0, seed: int = 0) -> int:
  """Prints the figures and returns the number of targets missed."""
  lines = figure_lines.Lines('C26', seed)
  repetitions = max(1, int(REPETITIONS * scale))
  with served.endlessly(f'--idle_seconds={IDLE_SECONDS}') as program:
    served.connect_eventually(program.address).close()
    before = _counts(program.process.pid)
    found = go_away_everywhere(program.address, repetitions)
    time.sleep(1.0)
    after = _counts(program.process.pid)
    rows = (program.output / 'episodes.jsonl').read_text()
    waking = wake_up_late(program.address, STOPPED_SECONDS * min(1.0, scale))
    has_died = program.process.poll() is not None
  expected = repetitions * len(WAYS) * len(_IS_MID_EPISODE)
  number = len(found)
  lines.at_most(
      f'slowest of {number} until free, s',
      max(one.seconds_until_free for one in found),
      2.0,
  )
  lines.at_most(
      'next without a clean FIRST', sum(not f.is_clean for f in found), 0
  )
  refusals = [one.seconds_until_refused for one in found]
  lines.at_most('slowest refusal of a second client, s', max(refusals), 0.1)
  lines.at_most(
      'episodes not marked',
      abs(rows.count('"end":"disconnect"') - expected),
      0,
  )
  lines.at_most('more threads', after[0] - before[0], 4)
  lines.at_most('more descriptors', after[1] - before[1], 8)
  lines.at_least(
      f'awake after {waking.seconds:.0f} s', waking.num_awake, len(POINTS)
  )
  lines.at_most(
      'disturbed by clients that continued', int(not waking.is_undisturbed), 0
  )
  lines.at_most('server deaths', int(has_died), 0)
  return lines.num_missed


def _counts(pid: int) -> tuple[int, int]:
  """Returns the numbers of threads and descriptors of a process."""
  return (
      len(os.listdir(f'/proc/{pid}/task')),
      len(os.listdir(f'/proc/{pid}/fd')),
  )


if __name__ == '__main__':
  figure_lines.run(main)
