"""Parts of worlds, each usable alone in any Composer task."""
