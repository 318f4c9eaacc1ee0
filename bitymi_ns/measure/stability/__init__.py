"""Float32 accuracy: extreme scenes, errors against float64 and extended precision, and a page of them."""
