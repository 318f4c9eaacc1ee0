"""Float32 errors of extreme scenes against float64 and extended precision, and the page that lists them."""
