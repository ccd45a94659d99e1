"""Re-implementations of the published methods that the paper compares with (Sec. 5.2)."""
