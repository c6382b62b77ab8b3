"""What robots can do, measured without a policy: one robot (bench), the robots between two (audit), and pictures of it (figure)."""
