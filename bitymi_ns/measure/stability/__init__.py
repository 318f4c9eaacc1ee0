"""Float32 errors on extreme scenes against float64 and extended precision, and the page that lists them."""
