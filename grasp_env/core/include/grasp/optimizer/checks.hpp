// Checks of the arguments of the constructor of `ForceOptimizer`.
#pragma once
#include <grasp/flow/flow.hpp>
#include <grasp/optimizer/current_contacts.hpp>

namespace grasp::detail {

// Throws std::invalid_argument.
inline void check(const CurrentContacts& contacts, const Options& options) {
  const auto refuse = [](bool wrong, const char* reason) {
    if (wrong) throw std::invalid_argument(reason);
  };
  const Contacts& home = contacts.home;
  const bool limited = contacts.limits.rows > 0;
  refuse(home.placing == Placing::refused || home.reach.rank == 0,
         "the contacts must be placed: Contacts::from");
  if (options.method == Method::reduced_flow || options.method == Method::full_flow) {
    refuse(limited || home.soft(),
           "the flows know hard contacts without limits: use newton or conic");
    refuse(home.placing != Placing::good,
           "the flows need contacts that balance wrenches of every direction: use newton or conic");
    refuse(options.method == Method::full_flow && home.count > FULL_CONTACTS,
           "the full flow is dense: at most 8 contacts");
  }
  refuse(!(options.tolerance <= 1.0), "the tolerance is a part of the objective: at most 1");
  refuse(options.elastic && !limited, "elastic belongs to limits: add limits");
  const Criterion criterion = options.criterion;
  refuse(criterion == Criterion::excess || criterion == Criterion::load ||
             (criterion != Criterion::sum && options.method != Method::conic),
         "the criterion belongs to conic: sum, largest or torque");
  refuse(criterion == Criterion::torque && contacts.joints == 0,
         "the criterion torque needs the hand's jacobian: add limits that have one");
  refuse(options.model && !options.model->fits(home.count),
         "the model is for another number of contacts");
}

}  // namespace grasp::detail
