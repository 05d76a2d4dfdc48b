"""Files from strangers are decoded in processes of their own, which have little memory, little time, and no secrets."""
