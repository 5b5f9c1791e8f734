"""Worlds for agents in other processes, over dm_env_rpc (extra `rpc`)."""
