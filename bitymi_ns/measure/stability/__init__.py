"""Float32 errors on extreme scenes against float64, and the page that lists them."""
