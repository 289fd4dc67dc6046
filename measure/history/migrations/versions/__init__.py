"""One module for each version; never changed after it was released."""
