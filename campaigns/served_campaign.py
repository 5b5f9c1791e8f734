"""Campaigns C16 and C24: messages to a served world that mean ill.

Run from the root of the repository, about two minutes in full:

    python -m campaigns.served_campaign [scale] [seed] [C24 ...]

C16 sweeps uids and message types, C24 sends mutated messages and hostile
sequences. The server is a process of its own. Prints a line per figure; the
exit status is the number of targets missed.
"""

import collections
from collections.abc import Callable, Iterator
import re
import time
from typing import Any, NamedTuple

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import tensor_utils
from dm_env_rpc.v1.extensions import properties_pb2
from google.protobuf import any_pb2
from google.rpc import code_pb2
import grpc
import numpy as np

from campaigns import figure_lines
from realab_suite.interop.rpc import refusals
from tests.interop import served

MESSAGES = 50_000
SEQUENCES = 2_000
UIDS = 65_536
RANDOM_UIDS = 5_000

_FAILED = refusals.Reason.FAILED.value[0]
_TEXTS = [
    re.compile(re.escape(f'{id_}: {text}').replace(r'\{\}', r'\d+'))
    for id_, _, text in (reason.value for reason in refusals.Reason)
]
_MAX_UINT64 = 2**64 - 1


# C16: what there is to be asked for.


class Sweep(NamedTuple):
  """What came of asking for everything."""

  num_asked: int
  num_observations: int
  num_strange: int


def sweep(
    stream: served.RawStream, num_uids: int, num_random: int, seed: int
) -> Sweep:
  """Asks for every uid, every kind of message and every setting."""
  generator = np.random.default_rng(seed)
  stream.ask(served.JOIN)
  specs = served.response(
      stream.ask(served.request(reset=pb.ResetRequest()))
  ).reset.specs
  sizes = {
      uid: (spec.name, tuple(spec.shape), spec.dtype)
      for uid, spec in specs.observations.items()
  }
  uids = [*range(num_uids)]
  uids += generator.integers(0, _MAX_UINT64, num_random, np.uint64).tolist()
  num_strange = num_observations = 0
  for uid in uids:
    step = pb.StepRequest(requested_observations=[uid], actions=served.ACTION)
    answer = served.response(stream.ask(served.request(step=step)))
    if uid not in sizes:
      expected = f'R09: observation {uid} is unknown'
      num_strange += answer.error.message != expected
      continue
    num_observations += 1
    found = dict(answer.step.observations)
    num_strange += list(found) != [uid]
    num_strange += tuple(found[uid].shape) != sizes[uid][1]
  others = [*OUTSIDE, *_settings(generator, max(10, num_random // 50))]
  for request in others:
    answer = served.response(stream.ask(request))
    is_plain = answer.WhichOneof('payload') == 'error' and not _is_strange(
        answer
    )
    num_strange += not is_plain
  return Sweep(len(uids) + len(others), num_observations, num_strange)


def _properties() -> Iterator[bytes]:
  property_request = properties_pb2.PropertyRequest
  for message in (
      property_request(
          read_property=properties_pb2.ReadPropertyRequest(key='score')
      ),
      property_request(
          write_property=properties_pb2.WritePropertyRequest(
              key='score', value=tensor_utils.pack_tensor(1.0)
          )
      ),
      property_request(list_property=properties_pb2.ListPropertyRequest()),
  ):
    packed = any_pb2.Any()
    packed.Pack(message)
    yield served.request(extension=packed)


def _settings(generator: Any, number: int) -> Iterator[bytes]:
  names = ['seed', 'task', 'design', 'true_reward', 'debug', 'world', '']
  for i in range(number):
    key = names[i] if i < len(names) else generator.bytes(6).hex()
    value = {key: tensor_utils.pack_tensor(1)}
    yield served.request(reset=pb.ResetRequest(settings=value))
    yield served.request(
        join_world=pb.JoinWorldRequest(world_name='world', settings=value)
    )
    yield served.request(create_world=pb.CreateWorldRequest(settings=value))


def run_c16(lines: figure_lines.Lines, scale: float, seed: int) -> None:
  with served.endlessly() as program:
    stream = served.RawStream(program.address)
    found = sweep(
        stream, int(UIDS * scale) + 20, int(RANDOM_UIDS * scale), seed
    )
    stream.close()
  lines.at_least('observations that there are', found.num_observations, 5)
  lines.at_most(f'strange replies of {found.num_asked}', found.num_strange, 0)


# C24: messages.


OUTSIDE = [
    served.request(create_world=pb.CreateWorldRequest()),
    served.request(destroy_world=pb.DestroyWorldRequest(world_name='world')),
    served.request(reset_world=pb.ResetWorldRequest(world_name='world')),
    served.request(extension=any_pb2.Any(type_url='a/b', value=b'c')),
    *_properties(),
]
_SEEDS = [served.JOIN, served.RESET, served.LEAVE, served.STEP, *OUTSIDE]


def mutate(generator: np.random.Generator) -> bytes:
  """Returns a message that began as a good one."""
  message = bytearray(_SEEDS[generator.choice([0, 1, 2, 3, 3, 3, 3, 4, 5, 7])])
  for _ in range(generator.integers(1, 4)):
    place = int(generator.integers(0, len(message) + 1))
    match generator.integers(7):
      case 0:  # A bit.
        if place < len(message):
          message[place] ^= 1 << generator.integers(8)
      case 1:  # An end.
        del message[place:]
      case 2:  # A hole.
        del message[place : place + int(generator.integers(1, 9))]
      case 3:  # Noise.
        message[place:place] = generator.bytes(int(generator.integers(1, 20)))
      case 4:  # An echo.
        message[place:place] = message[: int(generator.integers(0, 60))]
      case 5:  # Somebody else's tail.
        other = _SEEDS[generator.integers(len(_SEEDS))]
        message[place:] = other[int(generator.integers(0, len(other))) :]
      case 6:  # A large number where a small one was.
        message[place : place + 1] = b'\xff\xff\xff\xff\xff\xff\xff\xff\xff\x01'
  return bytes(message)


def compose(generator: np.random.Generator) -> bytes:
  """Returns a step whose parts are of the right kinds, and mostly wrong."""
  size = int(generator.choice([0, 1, 5, 6, 6, 6, 7, 100]))
  specials = [0.0, 1.0, -1.0, 1.5, np.nan, np.inf, -np.inf, 1e300]
  values = np.zeros(size)
  if size and generator.random() < 0.5:
    values[generator.integers(size)] = specials[generator.integers(8)]
  dtype = [np.float64, np.float64, np.float32, np.int32, np.uint8, np.bool_][
      generator.integers(6)
  ]
  with np.errstate(invalid='ignore', over='ignore'):
    tensor = tensor_utils.pack_tensor(values.astype(dtype))
  if generator.random() < 0.3:
    rank = int(generator.integers(0, 4))
    tensor.shape[:] = generator.integers(-1, 2**31 - 1, rank).tolist()
  uid = int(generator.choice([1, 1, 1, 0, 2])) if size else _MAX_UINT64
  uids = generator.integers(1, 11, generator.integers(0, 4)).tolist()
  step = pb.StepRequest(actions={uid: tensor}, requested_observations=uids)
  return served.request(step=step)


def _is_strange(answer: pb.EnvironmentResponse) -> bool:
  """Returns whether an answer says anything but what it may."""
  if answer.WhichOneof('payload') != 'error':
    return answer.WhichOneof('payload') is None
  error = answer.error
  if error.details or error.message.startswith(_FAILED):
    return True
  return not any(text.fullmatch(error.message) for text in _TEXTS)


class Fuzz(NamedTuple):
  """What came of a number of messages."""

  answers: collections.Counter[str]
  num_strange: int
  num_misplaced: int
  seconds: np.ndarray


def fuzz(ask: Callable[[bytes], bytes], number: int, seed: int) -> Fuzz:
  """Sends mutated messages, each of which has one answer."""
  generator = np.random.default_rng(seed)
  answers: collections.Counter[str] = collections.Counter()
  num_strange = num_misplaced = 0
  seconds = np.zeros(number)
  for i in range(number):
    if i % 100 == 99:
      # Were an answer missing or one too many, these would be others'.
      ask(served.JOIN)
      uid = 10**9 + i
      step = pb.StepRequest(actions=served.ACTION, requested_observations=[uid])
      said = served.response(ask(served.request(step=step))).error.message
      num_misplaced += str(uid) not in said
    # Now and then as it should be, or most would be refused for one reason.
    if i % 5 == 0:
      message = (served.JOIN, served.STEP)[i // 5 % 2]
    else:
      message = (mutate, compose)[i % 2](generator)
    start = time.perf_counter()
    answer = served.response(ask(message))
    seconds[i] = time.perf_counter() - start
    kind = answer.WhichOneof('payload') or 'none'
    answers[answer.error.message[:3] if kind == 'error' else kind] += 1
    num_strange += _is_strange(answer)
  return Fuzz(answers, num_strange, num_misplaced, seconds)


_NO_ERROR = 0
HOSTILE: dict[str, bytes] = {
    'join': served.JOIN,
    'reset': served.RESET,
    'leave': served.LEAVE,
    'step': served.STEP,
    'bare step': served.request(step=pb.StepRequest()),
    'greedy step': served.request(
        step=pb.StepRequest(
            actions=served.ACTION, requested_observations=[9] * 100_000
        )
    ),
    'strange uid': served.request(
        step=pb.StepRequest(
            actions=served.ACTION, requested_observations=[_MAX_UINT64]
        )
    ),
    'outside': OUTSIDE[0],
    'property': OUTSIDE[4],
    'settings': served.request(
        reset=pb.ResetRequest(settings={'seed': tensor_utils.pack_tensor(1)})
    ),
    'empty': b'',
    'noise': b'\xff' * 40,
}


class Model:
  """Says which code each request of a sequence should be answered with."""

  def __init__(self, max_steps: int = 20) -> None:
    self._max_steps = max_steps
    self.is_joined = False
    self._steps_left = 0

  def code(self, what: str) -> int:
    """Returns the code, and goes on to what is then."""
    if what in ('outside', 'property'):
      return code_pb2.PERMISSION_DENIED
    if what in ('empty', 'noise'):
      return code_pb2.INVALID_ARGUMENT
    if what == 'leave':
      self.is_joined = False
      return _NO_ERROR
    if what == 'join':
      was_joined, self.is_joined = self.is_joined, True
      if not was_joined:
        self._steps_left = 0
      return code_pb2.FAILED_PRECONDITION if was_joined else _NO_ERROR
    if not self.is_joined:
      return code_pb2.FAILED_PRECONDITION
    if what == 'settings':
      return code_pb2.PERMISSION_DENIED
    if what == 'reset':
      return code_pb2.FAILED_PRECONDITION if self._steps_left else _NO_ERROR
    if what == 'strange uid':
      return code_pb2.INVALID_ARGUMENT
    if not self._steps_left:
      self._steps_left = self._max_steps
      return _NO_ERROR
    if what == 'bare step':
      return code_pb2.INVALID_ARGUMENT
    self._steps_left -= 1
    return _NO_ERROR


def sequences(
    connect: Callable[[], served.RawStream], number: int, seed: int
) -> tuple[collections.Counter[str], int]:
  """Sends legal but hostile sequences; returns answers and wrong ones."""
  generator = np.random.default_rng(seed)
  names = list(HOSTILE)
  wrong = 0
  seen: collections.Counter[str] = collections.Counter()
  stream = connect()
  model = Model()
  for i in range(number):
    if i % 50 == 49:
      stream.close()
      stream = connect()
      model = Model()
    for _ in range(generator.integers(5, 30)):
      likely = ['step', 'join'] if generator.random() < 0.5 else names
      what = likely[generator.integers(len(likely))]
      answer = served.response(stream.ask(HOSTILE[what]))
      code = model.code(what)
      wrong += answer.error.code != code
      wrong += _is_strange(answer)
      seen[f'{what}: {code}'] += 1
  stream.close()
  return seen, wrong


def run_c24(lines: figure_lines.Lines, scale: float, seed: int) -> None:
  with served.endlessly() as program:
    pid = program.process.pid
    stream = served.connect_eventually(program.address)
    fuzz(stream.ask, 200, seed + 1)
    before = served.rss(pid)
    number = int(MESSAGES * scale)
    try:
      found = fuzz(stream.ask, number, seed)
    except grpc.RpcError as error:
      print(f'C24 the stream broke off: {error.code()}')
      lines.at_most('streams that broke off', 1, 0)
      return
    stream.close()
    print('C24 answers:', dict(found.answers.most_common()))
    lines.at_least('kinds of answers', len(found.answers), 12)
    lines.at_most(
        f'answers of {number // 100} that are not in their place',
        found.num_misplaced,
        0,
    )
    lines.at_most('strange answers', found.num_strange, 0)
    lines.at_most('p99, s', float(np.quantile(found.seconds, 0.99)), 1.0)
    number = int(SEQUENCES * scale) + 1
    seen, wrong = sequences(
        lambda: served.connect_eventually(program.address), number, seed
    )
    lines.at_least('kinds of requests and answers', len(seen), 15)
    lines.at_most(f'wrong answers in {number} sequences', wrong, 0)
    lines.at_most('memory growth, MiB', served.rss(pid) - before, 50)
    lines.at_most('server deaths', int(program.process.poll() is not None), 0)


_RUNS = {'C16': run_c16, 'C24': run_c24}


def main(scale: float = 1.0, seed: int = 0, *names: str) -> int:
  """Prints the figures and returns the number of targets missed."""
  return figure_lines.print_all(_RUNS, scale, seed, names)


if __name__ == '__main__':
  figure_lines.run(main)
