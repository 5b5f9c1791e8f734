"""Servers and clients for tests and campaigns of served worlds."""

from collections.abc import Callable, Iterator
import contextlib
import pathlib
import queue
import tempfile
import threading
from typing import Any, NamedTuple

from dm_env_rpc.v1 import connection as rpc_connection
from dm_env_rpc.v1 import dm_env_adaptor
from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import tensor_utils
import grpc
import numpy as np

from realab_suite import suite
from realab_suite.doors.served import agent_server
from realab_suite.doors.served import served_world
from realab_suite.engine import environment
from realab_suite.evaluation import results
from tests import patience
from tests.engine import helpers

ROOT = pathlib.Path(__file__).parents[3]
IDLE_SECONDS = 60.0
METHOD = '/dm_env_rpc.v1.Environment/Process'


def load(
    design: str = 'instantaneous_reward', max_steps: int = 20, seed: int = 0
) -> environment.Environment:
  """Returns the world that these tests serve."""
  return suite.load(
      'unlock_door',
      'near',
      {'random': seed},
      {'max_steps': max_steps},
      design=design,
  )


class Clock:
  """The clock of a server, which stands still until a test moves it on."""

  def __init__(self) -> None:
    self._now = 0.0
    self._loop: Any = None

  def control(self, server: agent_server.Server) -> None:
    """Becomes the clock of a server."""
    self._loop = server._loop
    self._loop.time = lambda: self._now

  def advance(self, seconds: float = IDLE_SECONDS) -> None:
    """Moves the clock on; by default, until a silent agent loses its world."""
    self._now += seconds
    self._loop.call_soon_threadsafe(lambda: None)


class Served(NamedTuple):
  """A server in a thread of this process.

  Attributes:
    address: The address at which it listens.
    server: The server.
    thread: The thread that runs the world.
    results: The results of episodes.
    clock: The clock by which agents are silent.
  """

  address: str
  server: agent_server.Server
  thread: threading.Thread
  results: list[results.EpisodeResult]
  clock: Clock

  def ends(self) -> list[str]:
    return [result.end.value for result in self.results]


@contextlib.contextmanager
def in_thread(
    make_env: Callable[[], environment.Environment] = load,
    *,
    num_episodes: int = 1_000_000,
    alter: Callable[[Any], None] = lambda world: None,
) -> Iterator[Served]:
  """Serves a world from a thread, which makes it, too."""
  results: list[Any] = []
  clock = Clock()
  ready = threading.Event()
  made: list[Any] = []
  with tempfile.TemporaryDirectory(prefix='realab-') as folder:
    address = f'unix:{folder}/socket'

    def serve() -> None:
      try:
        with contextlib.closing(make_env()) as env:
          world = served_world.ServedWorld(env, num_episodes, results.append)
          alter(world)
          server = agent_server.Server(world, address, IDLE_SECONDS)
          server.start()
          clock.control(server)
          made.append(server)
          ready.set()
          server.run()
      finally:
        ready.set()

    thread = threading.Thread(target=serve)
    thread.start()
    ready.wait(patience.SECONDS)
    try:
      yield Served(address, made[0], thread, results, clock)
    finally:
      if made:
        made[0].stop()
      thread.join(patience.SECONDS)


def _channel(address: str) -> grpc.Channel:
  # Otherwise a second channel shares the first one's connection.
  options = [('grpc.use_local_subchannel_pool', 1)]
  return grpc.insecure_channel(address, options=options)


class Client:
  """A client that sends any bytes, and returns the replies."""

  def __init__(self, address: str) -> None:
    self.channel = _channel(address)
    self.connection = rpc_connection.Connection(self.channel)

  def send(self, request: Any) -> Any:
    return self.connection.send(request)

  def join(self) -> Any:
    return self.send(pb.JoinWorldRequest(world_name='world')).specs

  def step(self, action: Any = None, uids: Any = ()) -> Any:
    actions = {} if action is None else {1: tensor_utils.pack_tensor(action)}
    return self.send(
        pb.StepRequest(actions=actions, requested_observations=uids)
    )

  def env(self) -> dm_env_adaptor.DmEnvAdaptor:
    return dm_env_adaptor.join_world(self.connection, 'world', {})

  def close(self) -> None:
    self.connection.close()
    self.channel.close()

  def __enter__(self) -> 'Client':
    return self

  def __exit__(self, *unused: Any) -> None:
    self.close()


class RawStream:
  """A stream of bytes, for requests that no honest client would send."""

  def __init__(self, address: str) -> None:
    self.channel = _channel(address)
    call = self.channel.stream_stream(METHOD)
    self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    self._answers = call(
        iter(self._requests.get, None), timeout=patience.SECONDS
    )

  def ask(self, request: bytes) -> bytes:
    self._requests.put(request)
    return next(self._answers)

  def tell(self, request: bytes) -> None:
    self._requests.put(request)

  def close(self) -> None:
    self._requests.put(None)
    self._answers.cancel()
    self.channel.close()


def to_bytes(time_step: Any) -> bytes:
  """Returns a time step canonically; a map on the wire has no order."""
  ordered = dict(sorted(time_step.observation.items()))
  return helpers.to_bytes(time_step._replace(observation=ordered))


def request(**payload: Any) -> bytes:
  """Returns a request as bytes."""
  return pb.EnvironmentRequest(**payload).SerializeToString()


def response(answer: bytes) -> pb.EnvironmentResponse:
  """Parses a reply."""
  return pb.EnvironmentResponse.FromString(answer)


# Requests that an honest client would send.
ACTION = {1: tensor_utils.pack_tensor(np.zeros(6))}
JOIN = request(join_world=pb.JoinWorldRequest(world_name='world'))
RESET = request(reset=pb.ResetRequest())
LEAVE = request(leave_world=pb.LeaveWorldRequest())
STEP = request(
    step=pb.StepRequest(actions=ACTION, requested_observations=[1, 2, 3, 8])
)


def still(env: Any) -> np.ndarray:
  """Returns an action that does nothing."""
  return np.zeros(env.action_spec().shape, env.action_spec().dtype)


def join_eventually(
    address: str, meanwhile: Callable[[], None] = lambda: None
) -> Client:
  """Returns a client that has joined, after earlier ones have left.

  Args:
    address: Address of the server.
    meanwhile: Called after each refusal.
  """
  joined = []

  def attempt() -> bool:
    client = Client(address)
    try:
      client.join()
    except grpc.RpcError:
      client.close()
      meanwhile()
      return False
    joined.append(client)
    return True

  patience.until(attempt)
  return joined[0]
