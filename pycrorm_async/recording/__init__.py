"""Any executive writes episodes through this package, also our own plan layer."""
