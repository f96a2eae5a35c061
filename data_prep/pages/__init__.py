"""Pages that show stored graphs: one HTML file each, no network, no script."""
