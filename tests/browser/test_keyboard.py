"""Keys of the page."""


def test_ctrl_z_undoes_a_change_of_a_parameter_and_ctrl_shift_z_redoes_it(fresh_desk):
    desk = fresh_desk
    before = desk.session.config.costs.q_track
    desk.session.configure({"costs.q_track": 8.0})
    desk.page.mouse.click(500, 200)
    desk.page.keyboard.press("Control+z")
    desk.wait_for(lambda: desk.session.config.costs.q_track == before, "the weight before")
    desk.page.keyboard.press("Control+Shift+z")
    desk.wait_for(lambda: desk.session.config.costs.q_track == 8.0, "the weight again")
