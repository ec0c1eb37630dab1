"""A lab's runs: listed, searched, noted upon and compared, from what stands in their folders."""
