// Returns the start of batch k of `layers` in the sorted list of `count` visible surfels.
fn layer_begin(count: u32, k: u32, layers: u32) -> u32 {
  return count / layers * k + min(k, count % layers);
}
