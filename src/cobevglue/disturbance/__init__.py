"""What goes wrong on the road, seeded per sample: detection errors, localisation noise and attack, latency, loss."""
