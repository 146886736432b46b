"""What photographs need to become observations."""
