"""What an expert learns from: scripted or recorded demonstrations, as functions of the observation."""
