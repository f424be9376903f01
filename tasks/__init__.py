"""What is computed: pure functions, arrays in and arrays out. No Dask, no paths, no global state."""
