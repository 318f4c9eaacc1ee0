"""How far float32 can be trusted: extreme scenes, errors against float64 and extended precision, a page of them."""
