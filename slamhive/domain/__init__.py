"""The vocabulary of the field as frozen, typed values. Nothing here touches a file, a clock or a network."""
