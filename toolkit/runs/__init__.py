"""A run on the disk: its folder, what it ran on, the seeds its episodes take, and what each phase leaves to be seen."""
