"""The page of the rollouts: an episode's caption, contacts and curves."""

def test_captions_say_which_episode_it_is_and_how_it_ended(rows):
    texts = [row["TextDocument:text"][0] for row in rows["/signals/caption"]]
    assert sum("seed 11" in text for text in texts) == 3 and any("unmodified jaco" in text for text in texts)
    assert all("**Success" in text or "**Failure" in text for text in texts if "seed" in text)


def test_contacts_and_signals_of_a_film(rows):
    forces = [row for row in rows["/scene/contacts"] if row.get("Arrows3D:vectors")]
    assert len(forces) > 20
    for key, width in (("position", 6), ("action", 7), ("distance", 2), ("grip", 1), ("reward", 2)):
        lines = [row for row in rows[f"/signals/{key}"] if "Scalars:scalars" in row]
        assert {len(row["Scalars:scalars"]) for row in lines} == {width}
    assert max(row["Scalars:scalars"][0] for row in rows["/signals/grip"] if "Scalars:scalars" in row) > 0.3
