"""Structure from motion by COLMAP, in a process of its own: `process.run` starts it, `worker` is what runs there."""
