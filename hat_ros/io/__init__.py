"""Between memory and the outside: messages, topics, image encodings, bags and result folders; no middleware."""
