#include "program_integrator.h"
#include "openmm/Context.h"
#include "openmm/Platform.h"
#include "openmm/System.h"
#include "openmm/serialization/SerializationNode.h"
#include "openmm/serialization/SerializationProxy.h"
#include <cmath>
#include <cstring>
#include <sstream>
using namespace OpenMM;
using namespace std;

namespace kcons {

static Planner planner = nullptr;
static thread_local string failure;   // what Python or a C function has to say

// -- the integrator, as OpenMM wants it -----------------------------------------------------------------

void ProgramIntegrator::initialize(ContextImpl& c) {
    if (owner != nullptr && &c.getOwner() != owner)
        throw OpenMMException("This Integrator is already bound to a context");
    if (planner == nullptr)
        throw OpenMMException("kcons: this integrator is made for its Context by Python; import kcons.openmm");
    // The base class tells the Context when the integrator goes first.
    owner = &c.getOwner();
    context = &c;
    handle = c.getPlatform().createKernel(StepKernel::Name(), c);
    handle.getAs<StepKernel>().begin(c, tied);
    middleKinetic = -1;
    shared.bound = 1;
}
Plan ProgramIntegrator::made() const {
    const System& system = context->getSystem();
    Plan plan;
    auto& given = plan.given;
    for (int k = 0; k < system.getNumParticles(); k++) given["masses"].push_back(system.getParticleMass(k));
    for (int k = 0; k < system.getNumConstraints(); k++) {
        int i, j; double length;
        system.getConstraintParameters(k, i, j, length);
        given["constraints"].insert(given["constraints"].end(), {double(i), double(j), length});
    }
    vector<Vec3> positions, box(3);
    context->getPositions(positions);
    if (system.usesPeriodicBoundaryConditions()) context->getPeriodicBoxVectors(box[0], box[1], box[2]);
    for (auto& place : positions) given["positions"].insert(given["positions"].end(), &place[0], &place[0]+3);
    for (auto& edge : box) given["box"].insert(given["box"].end(), &edge[0], &edge[0]+3);
    given["time"] = {context->getTime()};
    string platform = context->getPlatform().getName();
    if (!planner(&plan, static_cast<const Integrator*>(this), description.c_str(), platform.c_str(), getIntegrationForceGroups()))
        throw OpenMMException(failure);
    return plan;
}
void ProgramIntegrator::cleanup() { handle = Kernel(); shared.bound = shared.planned = 0; }
vector<string> ProgramIntegrator::getKernelNames() { return {StepKernel::Name()}; }
StepKernel& ProgramIntegrator::kernel() const {
    if (context == nullptr) throw OpenMMException("This Integrator is not bound to a context!");
    StepKernel& k = handle.getAs<StepKernel>();
    if (!shared.planned) { k.build(*context, made()); shared.planned = 1; }
    return k;
}
void ProgramIntegrator::step(int steps) {
    StepKernel& k = kernel();
    fill_n(shared.told, 7, 0);
    try {
        k.execute(*context, *this, steps);
    } catch (...) {
        middleKinetic = -1;
        k.valid = false;
        if (k.read("failure")[0] == 0) throw;
        k.lookBack();                              // it came of a failure, which is told
    }
    shared.moved = 0;                          // by barostats, which keep to the constraints
    vector<double> told = k.read("looked");    // the only wait of a call
    copy(told.begin(), told.end(), shared.told);
    if (told[2] != 0) {
        k.write("failure", {0, 0, 0});
        k.valid = false;
        throw OpenMMException("kcons: row "+to_string((int) told[4])+" could not be solved at step "+to_string((int) told[3]));
    }
    middleKinetic = shared.noisy && steps > 0 ? told[1]/2 : -1;
    endKinetic = told[6]/2;
}
void ProgramIntegrator::stateChanged(State::DataType changed) {
    if (context == nullptr) return;
    if (changed != State::Velocities) handle.getAs<StepKernel>().valid = false;
    if (changed == State::Positions || changed == State::Velocities) shared.moved = 1;
}
double ProgramIntegrator::computeKineticEnergy() {
    if (middleKinetic < 0) return handle.getAs<StepKernel>().kineticEnergy();
    kernel().lookBack();
    double now = kernel().read("looked")[6]/2;
    return fabs(now-endKinetic) <= 1e-7*endKinetic ? middleKinetic : now;
}
vector<double> ProgramIntegrator::read(const string& name) const { return kernel().read(name); }
void ProgramIntegrator::write(const string& name, const vector<double>& values) { kernel().write(name, values); }

// -- what belongs to a state ------------------------------------------------------------------------------

string ProgramIntegrator::saved() const {
    ostringstream text;
    text.precision(17);
    text << middleKinetic << ' ' << endKinetic;
    for (auto& array : kernel().plan.arrays) if (array.saved) {
        text << ' ' << array.values.size();
        for (double value : read(array.name)) text << ' ' << value;
    }
    return text.str();
}
void ProgramIntegrator::restore(const string& text, bool exactly) {
    istringstream words(text);
    vector<double> all;
    for (double value; words >> value;) all.push_back(value);
    map<string, vector<double>> found;
    size_t next = 2;
    bool known = all.size() >= next;
    for (auto& array : kernel().plan.arrays) if (array.saved && known) {
        double size = next < all.size() ? all[next++] : -1;
        bool same = size == array.values.size();
        known = size >= 0 && next+size <= all.size() && (same || !(exactly || array.name == "memory"));
        if (known && same) found[array.name].assign(&all[next], &all[next]+array.values.size());
        if (known) next += (size_t) size;
    }
    if (!known || next != all.size())
        throw OpenMMException("kcons: this state belongs to other steps or rows; OpenMM has taken over its positions and velocities, and the rest of it is left out");
    for (auto& each : found) write(each.first, each.second);
    middleKinetic = all[0]; endKinetic = all[1];
}
void ProgramIntegrator::createCheckpoint(ostream& out) const { out << saved() << '\n'; }
void ProgramIntegrator::loadCheckpoint(istream& in) {
    string text;
    getline(in, text);
    // Where constraints were added, `Context::reinitialize` brings what belongs to fewer rows.
    restore(text, false);
    kernel().valid = false;
}
void ProgramIntegrator::serializeParameters(SerializationNode& node) const {
    node.setIntProperty("version", 1).setStringProperty("state", saved());
}
void ProgramIntegrator::deserializeParameters(const SerializationNode& node) {
    string text = node.getStringProperty("state", "");
    if (!text.empty()) restore(text, true);    // else it is the state of another integrator
}

class Proxy : public SerializationProxy {
public:
    Proxy() : SerializationProxy("KconsProgram") {}
    void serialize(const void* object, SerializationNode& node) const override {
        auto& i = *static_cast<const ProgramIntegrator*>(static_cast<const Integrator*>(object));
        node.setIntProperty("version", 1).setDoubleProperty("stepSize", i.getStepSize());
        node.setDoubleProperty("constraintTolerance", i.getConstraintTolerance());
        node.setIntProperty("forceGroups", i.getIntegrationForceGroups()).setBoolProperty("noisy", i.shared.noisy);
        node.setStringProperty("description", i.description);
    }
    void* deserialize(const SerializationNode& node) const override {
        ProgramIntegrator* i = new ProgramIntegrator();
        i->setStepSize(node.getDoubleProperty("stepSize"));
        i->setConstraintTolerance(node.getDoubleProperty("constraintTolerance"));
        i->setIntegrationForceGroups(node.getIntProperty("forceGroups", -1));
        i->shared.noisy = node.getBoolProperty("noisy", false);
        i->description = node.getStringProperty("description");
        return static_cast<Integrator*>(i);
    }
};

// -- steps on all platforms -------------------------------------------------------------------------------

void StepKernel::execute(ContextImpl& c, ProgramIntegrator& integrator, int steps) {
    numbers.dt = integrator.getStepSize();
    numbers.tolerance = integrator.getConstraintTolerance();
    const Vec3 before[] = {numbers.box[0], numbers.box[1], numbers.box[2]};
    c.getPeriodicBoxVectors(numbers.box[0], numbers.box[1], numbers.box[2]);
    for (int k = 0; k < 3; k++) if (numbers.box[k] != before[k]) valid = false;
    const Shared& shared = integrator.shared;
    bool ended = true;                         // whether velocities are those of the end of a step
    for (int k = 0; k < steps; k++) {
        if (c.updateContextState()) {          // barostats have moved positions
            valid = false;
            c.getPeriodicBoxVectors(numbers.box[0], numbers.box[1], numbers.box[2]);
        }
        if (!valid || (plan.slots == 1 && c.getLastForceGroups() != plan.parts[0].back().groups)) {
            positionsMoved();
            vector<bool> known(plan.slots);
            for (int part : {0, 1}) for (auto& action : plan.parts[part])
                if (action.kernel.empty() && !known[action.slot]) { evaluate(c, action); known[action.slot] = true; }
        }
        run(c, shared, ended ? 0 : 1);
        c.setTime(c.getTime()+numbers.dt);
        c.setStepCount(c.getStepCount()+1);
        bool recorded = shared.every > 0 && (c.getStepCount()-shared.since) % shared.every == 0;
        ended = k == steps-1 || shared.whole || recorded;
        if (ended) run(c, shared, 2);
        if (recorded) launch("record");
    }
    lookBack();
}
void StepKernel::run(ContextImpl& c, const Shared& shared, int part) {
    numbers.time = c.getTime()-shared.origin;
    numbers.step = (int) c.getStepCount();
    bool moved = false;
    for (auto& action : plan.parts[part]) {
        if (!action.kernel.empty()) { launch(action.kernel); moved = true; }
        else {
            // Atoms may take new places only where no forces are kept that are still needed.
            if (moved) { c.computeVirtualSites(); positionsMoved(); }
            moved = false;
            evaluate(c, action);
        }
    }
}
void StepKernel::evaluate(ContextImpl& c, const Action& action) {
    c.calcForcesAndEnergy(true, false, action.groups);
    if (plan.slots > 1) keepForces(action.slot);
    valid = true;
}
const Array& StepKernel::declared(const string& name, long size) const {
    for (auto& array : plan.arrays) if (array.name == name) {
        if (size >= 0 && size != (long) array.values.size())
            throw OpenMMException("kcons: '"+name+"' has "+to_string(array.values.size())+" values, not "+to_string(size));
        return array;
    }
    throw OpenMMException("kcons: no array is called '"+name+"'");
}

static const bool registered = (SerializationProxy::registerProxy(typeid(ProgramIntegrator), new Proxy()), true);

}

// -- what Python calls; `integrator` is int(proxy.this) of the SWIG proxy, an OpenMM::Integrator* -----------

using namespace kcons;

static ProgramIntegrator& own(void* integrator) {
    return dynamic_cast<ProgramIntegrator&>(*static_cast<Integrator*>(integrator));
}
extern "C" {
const char* kcons_error() { return failure.c_str(); }
void kcons_set_error(const char* text) { failure = text; }
void kcons_set_planner(Planner p) { planner = p; }
void kcons_describe(void* integrator, const char* description, const int* tied, int n) {
    own(integrator).description = description;
    own(integrator).tied.assign(tied, tied+n);
}
Shared* kcons_shared(void* integrator) { return &own(integrator).shared; }
// The values of an array, until the next is read; null where that fails.
const double* kcons_read(void* integrator, const char* name, int* n) try {
    static thread_local vector<double> values;
    values = own(integrator).read(name);
    *n = values.size();
    return values.data();
} catch (exception& e) { failure = e.what(); return nullptr; }
int kcons_write(void* integrator, const char* name, const double* values, int n) try {
    own(integrator).write(name, vector<double>(values, values+n));
    return n;
} catch (exception& e) { failure = e.what(); return -1; }
// What a Plan was given for a Context, by name.
const double* kcons_plan_given(Plan* plan, const char* name, int* n) {
    *n = plan->given[name].size();
    return plan->given[name].data();
}
void kcons_plan_source(Plan* plan, const char* source, const char* library, int items, int workGroup, int slots) {
    plan->source = source; plan->library = library;
    plan->items = items; plan->workGroup = workGroup; plan->slots = slots;
}
void kcons_plan_array(Plan* plan, const char* name, int whole, int saved, const double* values, int n) {
    plan->arrays.push_back({name, whole != 0, saved != 0, vector<double>(values, values+n)});
}
void kcons_plan_action(Plan* plan, int part, const char* kernel, int groups, int slot) {
    plan->parts[part].push_back({kernel, groups, slot});
}
}
