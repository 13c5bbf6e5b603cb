"""Keep the blobs of a recorder beside its segments until the database has them."""
