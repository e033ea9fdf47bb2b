"""Free energies along held coordinates, and relaxed scans."""
