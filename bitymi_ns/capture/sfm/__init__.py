"""Structure from motion by COLMAP in a process of its own: `process.run` starts it, `worker` runs there."""
