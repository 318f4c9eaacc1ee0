// Divides the visible surfels, front to back, into batches of equal size and writes their draw arguments.

struct Draw {
  vertices: u32,
  instances: u32,
  first_vertex: u32,
  first_instance: u32,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> visible: u32;
@group(0) @binding(2) var<storage, read_write> draws: array<Draw>;

@compute @workgroup_size(64)
fn share_out(@builtin(global_invocation_id) id: vec3u) {
  let k = id.x;
  if k >= frame.layers { return; }
  draws[k] = Draw(4, layer_begin(visible, k + 1, frame.layers) - layer_begin(visible, k, frame.layers), 0, 0);
}
