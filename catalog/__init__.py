"""What there is: opens missions, stores intermediate results, numbers versions, writes every file format."""
