"""A world that is served: the agent's port in front, the evaluator behind."""

from collections.abc import Callable
import os
from typing import final

from absl import logging

from realab_suite.engine import agent_view
from realab_suite.engine import environment
from realab_suite.engine import events
from realab_suite.engine import seeding
from realab_suite.evaluation import evaluate
from realab_suite.evaluation import result_collector
from realab_suite.evaluation import results
from realab_suite.interop.rpc import agent_port
from realab_suite.interop.rpc import agent_server
from realab_suite.interop.rpc import sockets

OnEpisode = Callable[[evaluate.EpisodeResult, str], None]

_ROOT = 0


@final
class ServedWorld(agent_server.Service):
  """A world, what its agent may ask of it, and the results of its episodes."""

  def __init__(
      self,
      env: environment.Environment,
      address: str,
      num_episodes: int,
      on_episode: OnEpisode,
  ) -> None:
    """Makes the world ready; its first episode begins with the first step.

    Args:
      env: The environment, which stays the caller's to close. It needs a
        `SaltedSeed` for results of tier T2.
      address: Where it is served.
      num_episodes: After how many episodes there is no more to be had.
      on_episode: Called with the result of each episode, and with the tier of
        isolation that it was made under.
    """
    self._env = env
    self._address = address
    self._num_left = num_episodes
    self._on_episode = on_episode
    self._failures: list[Exception] = []
    self._collector = result_collector.ResultCollector(env)
    self._port = agent_port.AgentPort(
        agent_view.AgentView(env, self._failures), env.abandon
    )
    self._isolation = results.SERVED

  def connect(self) -> None:
    users = sockets.users_connected_to(self._address)
    # Root reaches everything; a user reaches what is the same user's. Without
    # a salt the episodes follow from the seed, which is public.
    is_apart = (
        users
        and not users & {_ROOT, os.getuid()}
        and isinstance(self._env.seed, seeding.SaltedSeed)
    )
    self._isolation = (
        results.SERVED_TO_ANOTHER_USER if is_apart else results.SERVED
    )

  def answer(self, request: bytes) -> bytes:
    if self._num_left <= 0:
      self._port.finish()
    return self._port.answer(request)

  def disconnect(self) -> None:
    self._port.disconnect()
    self._env.abandon(events.End.DISCONNECT)

  def settle(self) -> bool:
    for failure in self._failures:
      logging.error('the episode has failed', exc_info=failure)
    self._failures.clear()
    for result in self._collector.take():
      self._num_left -= 1
      self._on_episode(result, self._isolation)
    return self._num_left > 0
