"""Clients that overload a served world, or leave it at any point.

Small parts of the campaigns `served_limits` and `served_departures`.
"""

import itertools
import tracemalloc

import pytest

from campaigns import served_departures_campaign
from campaigns import served_limits_campaign
from tests.interop import served


@pytest.fixture(name='serving', scope='module')
def _serving():
  with served.in_thread() as serving:
    yield serving


def test_bombs_and_floods_do_not_disturb_the_agent():
  steps = 25
  digests = []
  for is_attacked in (False, True):
    with served.in_thread() as another:
      program = served.Program(another.address, None, None)
      stream = served.connect_eventually(another.address)
      for request in (served.JOIN, served.STEP):
        stream.ask(request)
      if is_attacked:
        tracemalloc.start()
        refused, _ = served_limits_campaign.bomb(stream, program)
        _, largest = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert refused == 8
        # An array of such a shape would take at least 3 GiB.
        assert largest < 16 * 2**20
        refused, _ = served_limits_campaign.many_settings(
            stream, program, 3_000
        )
        assert refused == 1
        refused, _ = served_limits_campaign.large_messages(stream, program)
        assert refused == 5
        refused, _ = served_limits_campaign.many_connections(
            stream, program, 30
        )
        assert refused == 10
      digests.append(served_limits_campaign.rollout(stream, steps))
      stream.close()
  assert digests[0] == digests[1]


def test_a_client_that_leaves_at_any_point_frees_the_world(serving):
  before = len(serving.results)
  found = served_departures_campaign.go_away_everywhere(
      serving.address, 1, ('cancel', 'close')
  )
  found += served_departures_campaign.go_away_everywhere(
      serving.address, 1, ('kill',), points=(1, 5, 11)
  )
  assert len(found) == 27
  assert all(one.is_clean for one in found)
  # The clock of the server stood still, so no client was found idle.
  ends = [end for end in serving.ends()[before:] if end == 'disconnect']
  assert len(ends) == 5 * 2 + 2


def test_a_client_that_continues_late_has_no_effect():
  points = list(served_departures_campaign.POINTS)
  chosen = [points.index('joined'), points.index('waiting for an answer')]
  with served.in_thread() as serving:
    found = served_departures_campaign.wake_up_late(
        serving.address, 0.1, chosen, serving.clock.advance
    )
    assert (found.num_awake, found.is_undisturbed) == (2, True)


def test_a_step_of_another_client_is_noticed():
  def alter(world):
    answer, count = world.answer, itertools.count()

    def answer_twice(request):
      if request == served.STEP and next(count) == 70:
        answer(request)
      return answer(request)

    world.answer = answer_twice

  with served.in_thread(alter=alter) as serving:
    play = served_departures_campaign.play
    assert play(serving.address) != play(serving.address)
