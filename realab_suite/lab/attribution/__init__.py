"""Attribution of corruption to its movers."""
