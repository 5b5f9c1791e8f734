"""Runs the compliance tests that dm_env_rpc brings, over a socket."""

from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
from dm_env_rpc.v1 import tensor_utils
from dm_env_rpc.v1.compliance import join_leave_world
from dm_env_rpc.v1.compliance import reset
from dm_env_rpc.v1.compliance import step
import numpy as np

from tests.doors.served import served


class _Served:
  """Serves a world for the tests of a class; a client for each of them."""

  @classmethod
  def setUpClass(cls):
    super().setUpClass()
    cls._serving = served.in_thread()
    cls._address = cls._serving.__enter__().address

  @classmethod
  def tearDownClass(cls):
    cls._serving.__exit__(None, None, None)
    super().tearDownClass()

  def setUp(self):
    super().setUp()
    self._client = served.join_eventually(self._address)
    self.addCleanup(self._client.close)
    self._client.send(pb.LeaveWorldRequest())

  @property
  def connection(self):
    return self._client.connection

  def world_specs(self):
    return self.connection.send(pb.JoinWorldRequest(world_name='world')).specs


class JoinLeaveTest(_Served, join_leave_world.JoinLeaveWorld):
  world_name = 'world'

  @property
  def invalid_join_settings(self):
    return {'seed': tensor_utils.pack_tensor(1)}


class ResetTest(_Served, reset.Reset):

  def join_world(self):
    return self.world_specs()


class StepTest(_Served, step.Step):

  def setUp(self):
    super().setUp()
    self._specs = self.world_specs()

  @property
  def specs(self):
    return self._specs

  @property
  def required_actions(self):
    return {1: tensor_utils.pack_tensor(np.zeros(6))}
